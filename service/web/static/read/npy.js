// Positions of an NPY array (N, >= 3) of floats.

export function readNpy(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const begin = bytes[6] === 1 ? 10 : 12;
  const size = bytes[6] === 1 ? view.getUint16(8, true) : view.getUint32(8, true);
  const header = new TextDecoder("latin1").decode(bytes.subarray(begin, begin + size));
  const type = /'descr':\s*'([<>=|]?)f([48])'/.exec(header);
  const shape = /'shape':\s*\(\s*(\d+)\s*,\s*(\d+)\s*,?\s*\)/.exec(header);
  if (!type || !shape || Number(shape[2]) < 3) throw new Error("not an (N, 3) array of f4 or f8");
  const [rows, columns] = [Number(shape[1]), Number(shape[2])];
  const isFortran = /'fortran_order':\s*True/.test(header);
  const width = Number(type[2]);
  const get = (width === 4 ? view.getFloat32 : view.getFloat64).bind(view);
  const isLittle = type[1] !== ">";
  const xyz = new Float64Array(3 * rows);
  for (let row = 0; row < rows; row++) {
    for (let axis = 0; axis < 3; axis++) {
      const item = isFortran ? axis * rows + row : row * columns + axis;
      xyz[3 * row + axis] = get(begin + size + item * width, isLittle);
    }
  }
  return xyz;
}
