// Draws one cloud with three.js: positions go from before to after on the GPU, and nothing is drawn while nothing changes.

import {
  BufferAttribute, BufferGeometry, Color, DataTexture, GLSL3, LinearFilter, PerspectiveCamera, Points, Scene, ShaderMaterial, Spherical,
  Vector3, WebGLRenderer,
} from "./vendor/three/three.module.min.js";
import { OrbitControls } from "./vendor/three/OrbitControls.js";
import { palette } from "./colours.js";
import { UNKNOWN } from "./cloud.js";

const VERTEX = `
  in vec4 after;
  uniform float blend, size, low, top, middle;
  uniform vec3 plain;
  uniform vec3 back;
  uniform sampler2D colours;
  out vec3 tint;
  void main() {
    bool known = after.w > ${(UNKNOWN / 2).toExponential()};
    bool there = known || after.x > ${(UNKNOWN / 2).toExponential()};
    vec4 seen = modelViewMatrix * vec4(known ? mix(position, after.xyz, blend) : position, 1.0);
    gl_Position = projectionMatrix * seen;
    gl_PointSize = there ? size : 0.0;
    if (!there) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    vec3 colour = known ? texture(colours, vec2(clamp((after.w - low) / (top > low ? top - low : 1.0), 0.0, 1.0), 0.5)).rgb : plain;
    // What is farther away fades a little: depth without light.
    float depth = clamp((-seen.z - middle) / 2.0 + 0.5, 0.0, 1.0);
    tint = mix(colour, back, 0.45 * depth);
  }
`;
const FRAGMENT = `
  in vec3 tint;
  uniform float size;
  out vec4 colour;
  void main() {
    if (size > 2.5 && length(gl_PointCoord - 0.5) > 0.5) discard;
    colour = vec4(tint, 1.0);
  }
`;
const STAGE = { dark: { back: 0x0e1113, plain: 0xa9b3ba }, light: { back: 0xf1f3f4, plain: 0x5d6972 } };
const FIELD_OF_VIEW = 40;
const MARGIN = 1.06;
const TURN = Math.PI / 24;

export class Viewer {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.sortObjects = false; // there is one; to sort it is to measure it, and NaN has no measure
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
    this.uniforms = {
      blend: { value: 1 }, size: { value: 2 }, low: { value: 0 }, top: { value: 1 }, middle: { value: 1 },
      plain: { value: new Color() }, back: { value: new Color() }, colours: { value: null },
    };
    this.material = new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms, glslVersion: GLSL3 });
    this.points = null;
    this.isMoved = false;
    this.setTheme("light");
    this.setUp("Z");
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    canvas.addEventListener("webglcontextrestored", () => this.draw());
    canvas.addEventListener("keydown", (event) => this.key(event));
    this.resize();
  }

  // Show a cloud, or nothing for null; the view is fitted to it.
  show(cloud) {
    if (this.points) {
      this.scene.remove(this.points);
      this.points.geometry.dispose();
      this.points = null;
    }
    this.cloud = cloud;
    this.isMoved = false;
    if (cloud) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(cloud.before, 3));
      geometry.setAttribute("after", new BufferAttribute(cloud.after, 4));
      this.points = new Points(geometry, this.material);
      this.points.frustumCulled = false;
      this.scene.add(this.points);
      this.fit();
    }
    this.draw();
  }

  // Take what has changed in the cloud; isWhole: it is complete, so fit the view unless someone has moved it.
  refresh({ isWhole = false } = {}) {
    if (!this.points) return;
    this.points.geometry.attributes.after.needsUpdate = true;
    if (!this.cloud.hasBefore) {
      this.points.geometry.attributes.position.needsUpdate = true;
      if (!this.isMoved) this.fit();
    } else if (isWhole && !this.isMoved) {
      this.fit();
    }
    this.draw();
  }

  setRange(low, top) {
    this.uniforms.low.value = low;
    this.uniforms.top.value = top;
    this.draw();
  }

  setBlend(value) {
    this.uniforms.blend.value = value;
    this.draw();
  }

  setPointSize(pixels) {
    this.uniforms.size.value = pixels * this.renderer.getPixelRatio();
    this.pixels = pixels;
    this.draw();
  }

  setTheme(theme) {
    const { back, plain } = STAGE[theme];
    // Raw sRGB values: the shader writes them as they are.
    for (const [name, hex] of [["back", back], ["plain", plain]]) {
      this.uniforms[name].value.setRGB(((hex >> 16) & 255) / 255, ((hex >> 8) & 255) / 255, (hex & 255) / 255);
    }
    this.renderer.setClearColor(back, 1);
    const colours = palette(theme);
    this.uniforms.colours.value?.dispose();
    const texture = new DataTexture(colours, colours.length / 4, 1);
    texture.minFilter = texture.magFilter = LinearFilter;
    texture.needsUpdate = true;
    this.uniforms.colours.value = texture;
    this.draw();
  }

  setUp(axis) {
    this.camera.up.set(0, axis === "Y" ? 1 : 0, axis === "Z" ? 1 : 0);
    // The controls take the direction when they are made.
    this.controls?.dispose();
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", () => (this.isMoved = true));
    this.fit();
  }

  // Bring the cloud to the radius 1 about 0, whatever its unit: the controls take small moves for none. Show all of it.
  fit() {
    const { centre, radius } = this.cloud?.bounds() ?? { centre: [0, 0, 0], radius: 1 };
    this.points?.scale.setScalar(1 / radius);
    this.points?.position.fromArray(centre).divideScalar(-radius);
    this.points?.updateMatrix();
    const { y, z } = this.camera.up;
    const direction = new Vector3(0.75, z ? -1 : 0.55, y ? 1 : 0.55).normalize();
    this.camera.position.copy(direction).multiplyScalar(this.distanceFor(direction));
    this.controls.target.set(0, 0, 0);
    this.controls.minDistance = 1e-3;
    this.controls.maxDistance = 50;
    this.controls.update();
    this.draw();
  }

  // How far from the centre the camera sees all but a few strays.
  distanceFor(direction) {
    const slope = Math.tan((FIELD_OF_VIEW / 2) * (Math.PI / 180));
    const right = new Vector3().crossVectors(this.camera.up, direction).normalize();
    const up = new Vector3().crossVectors(direction, right);
    const needed = [];
    const point = new Vector3();
    this.cloud?.eachSample((x, y, z) => {
      point.set(x, y, z).applyMatrix4(this.points.matrix);
      const across = Math.max(Math.abs(point.dot(right)) / this.camera.aspect, Math.abs(point.dot(up))) / slope;
      needed.push(across + point.dot(direction));
    });
    if (needed.length === 0) return 1.1 / slope;
    const sorted = Float64Array.from(needed).sort();
    return Math.max(MARGIN * sorted[Math.ceil(0.998 * (sorted.length - 1))], 1e-6);
  }

  key(event) {
    const turns = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] };
    const zooms = { "+": 0.85, "=": 0.85, "-": 1 / 0.85 };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in turns) this.turn(...turns[event.key], 1);
    else if (event.key in zooms) this.turn(0, 0, zooms[event.key]);
    else if (event.key === "f" || event.key === "F") this.fit();
    else return;
    event.preventDefault();
  }

  turn(around, over, closer) {
    this.isMoved = true;
    const { y } = this.camera.up;
    const offset = this.camera.position.clone().sub(this.controls.target);
    // Spherical counts from y.
    const swapped = y ? offset : new Vector3(offset.x, offset.z, -offset.y);
    const angles = new Spherical().setFromVector3(swapped);
    angles.theta += around;
    angles.phi += over;
    angles.radius *= closer;
    swapped.setFromSpherical(angles.makeSafe());
    this.camera.position.copy(this.controls.target).add(y ? swapped : new Vector3(swapped.x, -swapped.z, swapped.y));
    this.controls.update();
    this.draw();
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.setPointSize(this.pixels ?? 2);
    if (!this.isMoved) this.fit();
    this.draw();
  }

  // Draw once in the next frame, however often it is asked for.
  draw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      const distance = this.camera.position.length();
      this.camera.near = Math.max(distance - 3, distance * 1e-3, 1e-9);
      this.camera.far = distance + 10;
      this.camera.updateProjectionMatrix();
      this.uniforms.middle.value = distance;
      this.renderer.render(this.scene, this.camera);
    });
  }
}
