"""LAS and LAZ where they could lose something or take too much: lossy packing, bombs, names, waveforms."""

from __future__ import annotations

import re
import struct
import sys
import tracemalloc
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, MissingDependency, TooManyBytes, UnsupportedCloud
from straightpcf.points.formats import format_named, read_cloud, write_cloud
from straightpcf.points.formats.base import check_unpacked
from tests.clouds import torus
from tests.points.foreign_samples import OTHER_SAMPLES

laspy = pytest.importorskip("laspy", reason="laspy, of the extra straightpcf[dev], is not installed")
N = 50


def _waveform_file(path: Path, point_format: int, *, is_noise: bool) -> Path:
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.3")
    header.scales = np.full(3, 0.01)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = torus(N).T
    rows = cloud.points.array
    if is_noise:
        noise = np.random.default_rng(0).integers(0, 256, rows.nbytes, np.uint8)
        rows[:] = np.frombuffer(noise.tobytes(), rows.dtype)
    else:
        rows["wavepacket_index"], rows["wavepacket_size"] = 1, 256
        rows["wavepacket_offset"], rows["x_t"] = 60 + 256 * np.arange(N), np.linspace(0, 1, N)
    cloud.write(path)
    return path


@pytest.mark.parametrize("point_format", [4, 5, 9, 10])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_moved_points_keep_their_wave_packets(point_format: int, suffix: str, tmp_path: Path) -> None:
    before = _waveform_file(tmp_path / f"a{suffix}", point_format, is_noise=False)
    cloud, format = read_cloud(before)
    write_cloud(cloud.with_xyz(cloud.xyz + 0.5), after := tmp_path / f"b{suffix}", format)
    again, _ = read_cloud(after)
    for name, values in cloud.attributes.items():
        assert again.attributes[name].tobytes() == values.tobytes(), name


@pytest.mark.parametrize(("offset", "far"), [(0, 1e30), (0, 1e6), ((691_000.0, 5_334_000.0, 520.0), 0.0)])
def test_a_far_point_that_would_put_all_others_in_wrong_places_is_refused_and_named(
    offset: Any, far: float, tmp_path: Path
) -> None:
    """The 32 bits of LAS reach from the farthest point to the others: 1e30 for "no data", or zeros in UTM."""
    xyz = torus(N) + offset
    format = format_named("las")
    format.check(PointCloud(xyz))
    xyz[7] = far
    with pytest.raises(UnsupportedCloud, match=rf"point 7, \[{re.escape(str(far))}, .*take it out, or another format"):
        format.check(PointCloud(xyz))


@pytest.mark.parametrize(("numbers", "counts"), [(None, [N, 0, 0]), (np.arange(N) % 3 + 1.0, [17, 17, 16])])
def test_a_new_file_counts_its_points_by_return(numbers: Any, counts: list[int], tmp_path: Path) -> None:
    attributes: dict[str, npt.NDArray[Any]] = {} if numbers is None else {"return_number": numbers}
    write_cloud(PointCloud(torus(N), attributes), out := tmp_path / "new.las", format_named("las"))
    assert laspy.read(out).header.number_of_points_by_return[:3].tolist() == counts


def _copc_file(path: Path, *chunks: int) -> Path:
    """Write what a reader that knows no COPC sees of it: its record first, and chunks of so many points."""
    lazrs = pytest.importorskip("lazrs", reason="lazrs, of the extra straightpcf[las], is not installed")
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.header.scales = np.full(3, 0.001)
    cloud.x, cloud.y, cloud.z = torus(sum(chunks)).T
    cloud.vlrs.append(laspy.VLR("copc", 1, "", bytes(160)))
    cloud.write(unpacked := BytesIO())
    raw, rows = unpacked.getvalue(), cloud.points.array.view(np.uint8).reshape(sum(chunks), -1)
    (begin,) = struct.unpack_from("<I", raw, 96)
    vlr = lazrs.LazVlr.new_for_compression(6, 0, True)
    record = bytes(vlr.record_data())
    head = raw[:begin] + struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(record), b"") + record
    sink = BytesIO()
    sink.write(head)
    packer = lazrs.LasZipCompressor(sink, vlr)
    for number, part in enumerate(np.split(rows, np.cumsum(chunks)[:-1])):
        if number:
            packer.finish_current_chunk()
        packer.compress_many(part.reshape(-1))
    packer.done()
    packed = bytearray(sink.getvalue())
    struct.pack_into("<IIB", packed, 96, len(head), 2, 6 | 0x80)
    path.write_bytes(packed)
    return path


def test_a_copc_file_is_read_and_written_in_other_formats_but_its_index_is_not_made_wrong(tmp_path: Path) -> None:
    cloud, format = read_cloud(_copc_file(tmp_path / "a.copc.laz", 30, 7, 13))
    np.testing.assert_allclose(cloud.xyz, torus(N), rtol=0, atol=6e-4)
    format_named("ply").check(cloud)
    write_cloud(cloud.with_xyz(cloud.xyz + 0.5), out := tmp_path / "a.ply", format_named("ply"))
    np.testing.assert_array_equal(read_cloud(out)[0].xyz, cloud.xyz + 0.5)
    for name in ("las", "laz"):
        with pytest.raises(UnsupportedCloud, match=r"a COPC file is indexed by position.*take another format, as PLY"):
            format_named(name).check(cloud)
        with pytest.raises(UnsupportedCloud, match="a COPC file is indexed by position"):
            write_cloud(cloud.with_xyz(cloud.xyz + 0.5), tmp_path / f"b.{name}", format_named(name))
    write_cloud(cloud, again := tmp_path / "c.copc.laz", format)  # nothing has moved
    assert again.read_bytes() == (tmp_path / "a.copc.laz").read_bytes()


def test_points_that_only_the_count_of_before_1_4_counts_are_read(tmp_path: Path) -> None:
    raw = bytearray(_waveform_file(path := tmp_path / "a.las", 9, is_noise=False).read_bytes())
    struct.pack_into("<I", raw, 107, N)
    struct.pack_into("<Q", raw, 247, 0)
    path.write_bytes(raw)
    assert len(read_cloud(path)[0]) == N


@pytest.mark.parametrize("point_format", [9, 10])
def test_what_lazrs_cannot_pack_without_loss_is_refused_as_laz_and_kept_as_las(
    point_format: int, tmp_path: Path
) -> None:
    """lazrs 0.8 drops bits of layered wave packets that jump; should it learn better, the fields must be equal."""
    cloud, las = read_cloud(_waveform_file(tmp_path / "a.las", point_format, is_noise=True))
    packed, laz = read_cloud(_waveform_file(tmp_path / "a.laz", point_format, is_noise=True))
    middle = cloud.xyz * 0.5
    try:
        write_cloud(packed.with_xyz(packed.xyz * 0.5), tmp_path / "b.laz", laz)
    except UnsupportedCloud as refusal:
        assert "without loss; write LAS" in refusal.message  # noqa: PT017 - either outcome is right
    else:
        again, _ = read_cloud(tmp_path / "b.laz")
        assert all(again.attributes[n].tobytes() == v.tobytes() for n, v in packed.attributes.items())
    write_cloud(cloud.with_xyz(middle), tmp_path / "b.las", las)
    again, _ = read_cloud(tmp_path / "b.las")
    assert all(again.attributes[n].tobytes() == v.tobytes() for n, v in cloud.attributes.items())


@pytest.mark.parametrize("point_format", [9, 10])
def test_a_check_packs_some_wave_packets_as_a_trial(point_format: int, tmp_path: Path) -> None:
    """lazrs 0.8 drops bits of these (above): whoever filters for an hour first is told so before."""
    cloud, laz = read_cloud(_waveform_file(tmp_path / "a.laz", point_format, is_noise=True))
    try:
        write_cloud(cloud.with_xyz(cloud.xyz * 0.5), tmp_path / "b.laz", laz)
    except UnsupportedCloud:
        with pytest.raises(UnsupportedCloud, match="without loss; write LAS"):
            laz.check(cloud)
    else:
        laz.check(cloud)
    calm, _ = read_cloud(_waveform_file(tmp_path / "a.laz", point_format, is_noise=False))
    laz.check(calm)


@pytest.mark.parametrize(("point_format", "is_packed_again"), [(1, True), (6, True), (4, False), (9, False)])
def test_chunks_of_varying_size_are_refused_by_the_check_where_they_have_no_packing(
    point_format: int, is_packed_again: bool, tmp_path: Path
) -> None:
    import lazrs

    header = laspy.LasHeader(point_format=point_format, version={1: "1.2", 4: "1.3"}.get(point_format, "1.4"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = torus(N).T
    cloud.write(tmp_path / "a.las")
    raw = (tmp_path / "a.las").read_bytes()
    (begin,), (row_bytes,) = struct.unpack_from("<I", raw, 96), struct.unpack_from("<H", raw, 105)
    kind = lazrs.LazVlr.new_for_compression(point_format, 0, True)
    record = bytes(kind.record_data())
    record = struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(record), b"") + record
    head = bytearray(raw[:begin]) + record
    struct.pack_into("<II", head, 96, len(head), struct.unpack_from("<I", head, 100)[0] + 1)
    head[104] |= 0x80
    sink = BytesIO(bytes(head))
    sink.seek(len(head))
    packer = lazrs.LasZipCompressor(sink, kind)
    packer.compress_many(raw[begin : begin + 20 * row_bytes])
    packer.finish_current_chunk()
    packer.compress_many(raw[begin + 20 * row_bytes : begin + N * row_bytes])
    packer.done()
    (tmp_path / "a.laz").write_bytes(sink.getvalue())
    found, laz = read_cloud(tmp_path / "a.laz")
    np.testing.assert_allclose(found.xyz, torus(N), atol=0.01)
    if is_packed_again:
        laz.check(found)
    else:
        with pytest.raises(UnsupportedCloud, match=f"format {point_format} cannot be packed as LAZ; write LAS"):
            laz.check(found)


def test_points_that_have_no_packing_are_refused_by_the_check(tmp_path: Path) -> None:
    cloud, _ = read_cloud(_waveform_file(tmp_path / "a.las", 4, is_noise=False))
    format_named("las").check(cloud)
    with pytest.raises(UnsupportedCloud, match="format 4 cannot be packed as LAZ; write LAS"):
        format_named("laz").check(cloud)


def test_points_that_come_out_of_lazrs_changed_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import lazrs

    class Forgetful:
        def __init__(self, sink: BytesIO, record: lazrs.LazVlr) -> None:
            self._packer = compressor(sink, record)

        def compress_many(self, points: npt.NDArray[np.uint8]) -> None:
            self._packer.compress_many(bytes(points[:-1]) + bytes([points[-1] ^ 1]))

        def done(self) -> None:
            self._packer.done()

    compressor = lazrs.LasZipCompressor
    cloud, laz = read_cloud(OTHER_SAMPLES["laz 1.4 format 8"](tmp_path))
    monkeypatch.setattr(lazrs, "LasZipCompressor", Forgetful)
    with pytest.raises(UnsupportedCloud, match=f"point {len(cloud) - 1} as LAZ without loss"):
        write_cloud(cloud.with_xyz(cloud.xyz + 1), tmp_path / "b.laz", laz)


def test_a_laz_bomb_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    """A layer that never changes takes no byte, so points may declare any number; here 60 say they are 6 million."""
    path = OTHER_SAMPLES["laz 1.4 format 8"](tmp_path)
    broken = bytearray(path.read_bytes())
    struct.pack_into("<Q", broken, 247, 6_000_000)
    path.write_bytes(broken)
    with pytest.raises(TooManyBytes, match=r"288000000 bytes unpacked; the limit for \d+ bytes is 268435456"):
        read_cloud(path, max_points=2**40)


def test_dimensions_that_become_float64_count_as_such_in_what_a_file_unpacks_to(tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    for number in range(100):
        header.add_extra_dim(laspy.ExtraBytesParams(f"e{number}", "u1", scales=np.array([0.5]), offsets=np.zeros(1)))
    theirs = laspy.LasData(header)
    theirs.x, theirs.y, theirs.z = torus(N).T
    theirs.write(path := tmp_path / "a.laz")
    assert len(read_cloud(path)[0]) == N
    broken = bytearray(path.read_bytes())
    struct.pack_into("<Q", broken, 247, 1_500_000)  # 195 MB packed in rows of 130 bytes
    path.write_bytes(broken)
    with pytest.raises(TooManyBytes, match=r"1395000000 bytes unpacked"):
        read_cloud(path)


def test_a_larger_file_may_unpack_to_a_multiple_of_itself() -> None:
    check_unpacked(40 << 24, 1 << 24, what="a scan")
    with pytest.raises(TooManyBytes, match=r"a scan declares 671088641 .* 16777216 bytes is 671088640"):
        check_unpacked((40 << 24) + 1, 1 << 24, what="a scan")


@pytest.mark.parametrize(("suffix", "reads", "writes"), [(".las", 1, 1.5), (".laz", 1.5, 2)])
def test_reading_and_writing_hold_no_more_copies_than_they_need(
    suffix: str, reads: float, writes: float, tmp_path: Path
) -> None:
    """In sizes of the unpacked points; beside them stand the positions, twice, and a block that is compared."""
    attributes = {f"a{i}": np.zeros(20_000) for i in range(100)}
    write_cloud(PointCloud(torus(20_000), attributes), path := tmp_path / f"a{suffix}", format_named(suffix[1:]))
    del attributes
    tracemalloc.start()
    try:
        cloud, format = read_cloud(path)
        unpacked = cloud.source.rows.nbytes
        assert tracemalloc.get_traced_memory()[1] < (reads + 0.2) * unpacked
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        write_cloud(cloud.with_xyz(cloud.xyz + 1), tmp_path / f"b{suffix}", format)
        assert tracemalloc.get_traced_memory()[1] - before < writes * unpacked
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_cut_file_is_malformed(suffix: str, tmp_path: Path) -> None:
    name = "las 1.4 format 7" if suffix == ".las" else "laz 1.4 format 8"
    path = OTHER_SAMPLES[name](tmp_path)
    whole = path.read_bytes()
    begin = struct.unpack_from("<I", whole, 96)[0]
    for length in (100, 226, 300, begin - 1, begin + 4, begin + 30):
        path.write_bytes(whole[:length])
        with pytest.raises(MalformedFile):
            read_cloud(path)


def test_laz_without_lazrs_names_the_extra_and_las_needs_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = OTHER_SAMPLES["laz 1.2 format 1"](tmp_path)
    plain = OTHER_SAMPLES["las 1.2 format 3"](tmp_path)
    monkeypatch.setitem(sys.modules, "lazrs", None)
    cloud, _ = read_cloud(plain)
    with pytest.raises(MissingDependency, match=r"pip install 'straightpcf\[las\]'"):
        read_cloud(packed)
    with pytest.raises(MissingDependency, match=r"pip install 'straightpcf\[las\]'"):
        write_cloud(cloud, tmp_path / "b.laz", format_named("laz"))


def test_attributes_whose_long_names_begin_alike_all_come_back(tmp_path: Path) -> None:
    """LAS has 32 bytes for the name of an extra dimension."""
    attributes = {f"{'n' * 40}{i}": np.random.default_rng(i).random(N) for i in range(12)}
    write_cloud(PointCloud(torus(N), attributes), path := tmp_path / "a.las", format_named("las"))
    cloud, _ = read_cloud(path)
    kept = [values for name, values in cloud.attributes.items() if "nnn" in name]
    assert len(kept) == 12
    for values, expected in zip(kept, attributes.values(), strict=True):
        np.testing.assert_array_equal(values, expected)
    theirs = laspy.read(path)
    assert len(set(theirs.point_format.extra_dimension_names)) == 12


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_attributes_with_names_of_dimensions_are_put_there_or_beside_them(suffix: str, tmp_path: Path) -> None:
    """laspy opens no file in which an extra dimension is called as a standard one, or as a part of its own record."""
    held: dict[str, npt.NDArray[Any]] = {
        "intensity": np.arange(N, dtype=np.float32) * 1300,
        "return_number": np.arange(N) % 8,
        "number_of_returns": np.full(N, 7, np.uint8),
        "classification": np.arange(N) % 32.0,
        "withheld": np.arange(N) % 2 == 1,
        "scan_angle_rank": np.arange(N, dtype=np.int16) - 90,
        "point_source_id": np.arange(N, dtype=np.uint32),
        "gps_time": np.linspace(0, 1, N, dtype=np.float32),
    }
    beside: dict[str, npt.NDArray[Any]] = {
        "user_data": np.arange(N) * 100.0,
        "key_point": np.full(N, 2, np.uint8),
        "synthetic": np.linspace(0, 1, N),
        "bit_fields": np.arange(N, dtype=np.uint8),
        "header": np.linspace(0, 1, N),
        "scales": np.linspace(0, 2, N),
        "offsets": np.linspace(0, 3, N),
    }
    write_cloud(PointCloud(torus(N), held | beside), tmp_path / f"a.{suffix}", format_named(suffix))
    theirs = laspy.read(tmp_path / f"a.{suffix}")
    for name, values in held.items():
        np.testing.assert_array_equal(theirs[name], values.astype(np.float64), name)
    for name, values in beside.items():
        np.testing.assert_array_equal(theirs[f"extra_{name}"], values, name)
    assert not any(np.any(theirs[name]) for name in ("user_data", "key_point", "synthetic"))


@pytest.mark.parametrize(
    "said",
    [
        ("Intensity", "ReturnNumber", "NumberOfReturns", "Classification", "GpsTime", "PointSourceId"),  # PDAL's CSV
        ("scalar_Intensity", "scalar_Return_Number", "scalar_Number_Of_Returns", "scalar_Classification",
         "scalar_Gps_Time", "scalar_Point_Source_ID"),  # CloudCompare's PLY
        ("INTENSITY", "return number", "number-of-returns", "CLASSIFICATION", "GPS Time", "point source id"),
    ],
)  # fmt: skip
def test_dimensions_as_other_programs_call_them_are_put_there(said: tuple[str, ...], tmp_path: Path) -> None:
    names = ("intensity", "return_number", "number_of_returns", "classification", "gps_time", "point_source_id")
    values = np.arange(N) % 5 + 1.0
    cloud = PointCloud(torus(N), {name: values + place for place, name in enumerate(said)})
    assert format_named("las").left_behind(cloud) == []
    write_cloud(cloud, out := tmp_path / "out.las", format_named("las"))
    theirs = laspy.read(out)
    assert list(theirs.point_format.extra_dimension_names) == []
    for place, name in enumerate(names):
        np.testing.assert_array_equal(theirs[name], values + place)


def test_a_dimension_of_two_names_or_numbers_that_do_not_fit_is_beside_it(tmp_path: Path) -> None:
    share = np.linspace(0, 1, N)
    attributes = {"Intensity": share, "GpsTime": share, "GPSTIME": share, "User Data": share + 256}
    write_cloud(PointCloud(torus(N), attributes), out := tmp_path / "out.las", format_named("las"))
    theirs = laspy.read(out)
    assert list(theirs.point_format.extra_dimension_names) == ["Intensity", "GpsTime", "GPSTIME", "User_Data"]
    np.testing.assert_array_equal(theirs["Intensity"], share)


def test_intensity_that_is_no_whole_number_stays_what_it_is(tmp_path: Path) -> None:
    """A KITTI frame's is in 0..1, and a table may hold `extra_intensity`, too."""
    attributes = {"intensity": np.linspace(0, 1, N, dtype=np.float32), "extra_intensity": np.arange(N)}
    write_cloud(PointCloud(torus(N), attributes), path := tmp_path / "a.las", format_named("las"))
    theirs = laspy.read(path)
    np.testing.assert_array_equal(theirs["extra_extra_intensity"], attributes["intensity"])
    np.testing.assert_array_equal(theirs["extra_intensity"], attributes["extra_intensity"])


def test_extra_bytes_are_read_with_their_scale_and_offset_and_kept_as_they_are(tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=0)
    header.add_extra_dim(laspy.ExtraBytesParams("Amplitude", "u2", scales=np.array([0.01]), offsets=np.array([0.0])))
    header.add_extra_dim(laspy.ExtraBytesParams("Deviation", "i4", scales=np.array([0.5]), offsets=np.array([-3.0])))
    header.add_extra_dim(laspy.ExtraBytesParams("plain", "u2"))
    theirs = laspy.LasData(header)
    theirs.x, theirs.y, theirs.z = torus(N).T
    theirs.Amplitude, theirs.Deviation, theirs.plain = np.arange(N) * 0.25, np.arange(N) - 3.5, np.arange(N)
    theirs.write(tmp_path / "a.las")
    cloud, las = read_cloud(tmp_path / "a.las")
    np.testing.assert_allclose(cloud.attributes["Amplitude"], np.arange(N) * 0.25, atol=1e-12)
    np.testing.assert_array_equal(cloud.attributes["Deviation"], np.arange(N) - 3.5)
    assert cloud.attributes["plain"].dtype == np.uint16
    write_cloud(cloud.with_xyz(cloud.xyz + 1), tmp_path / "b.las", las)
    again = laspy.read(tmp_path / "b.las")
    np.testing.assert_array_equal(again.points.array["Amplitude"], theirs.points.array["Amplitude"])
    write_cloud(cloud, tmp_path / "a.ply", format_named("ply"))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ply")[0].attributes["Amplitude"], np.arange(N) * 0.25)


def test_extra_bytes_of_two_and_three_values_are_read_and_what_stands_behind_them_too(tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=0)
    header.add_extra_dim(laspy.ExtraBytesParams("normal", "3f4"))
    header.add_extra_dim(laspy.ExtraBytesParams("uv", "2u2", scales=np.array([0.5, 2]), offsets=np.array([1.0, 0])))
    header.add_extra_dim(laspy.ExtraBytesParams("quality", "f4"))
    theirs = laspy.LasData(header)
    theirs.xyz = torus(N)
    theirs["normal"], theirs["quality"] = torus(N).astype("f4"), np.arange(N)
    theirs.points.array["uv"] = np.arange(N)[:, None]
    theirs.write(tmp_path / "a.las")
    cloud, _ = read_cloud(tmp_path / "a.las")
    np.testing.assert_array_equal(cloud.attributes["normal"], torus(N).astype("f4"))
    np.testing.assert_array_equal(cloud.attributes["uv"], np.arange(N)[:, None] * [0.5, 2] + [1, 0])
    np.testing.assert_array_equal(cloud.attributes["quality"], np.arange(N))
    assert "extra_bytes" not in cloud.attributes


WGS84 = b'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["degree",0.0174532925199433]]'
UTM = b'PROJCS["WGS 84 / UTM zone 32N",' + WGS84 + b',PROJECTION["Transverse_Mercator"],UNIT["metre",1]]'
SYSTEMS = {
    "WGS84": (2112, WGS84),
    "WGS84 and heights": (2112, b'COMPD_CS["a",' + WGS84 + b',VERT_CS["b"]]'),
    "WGS84 of 2019": (2112, b'GEOGCRS["WGS 84",CS[ellipsoidal,2]]'),
    "WGS84, spelt otherwise": (2112, WGS84.replace(b"GEOGCS[", b"geogcs [")),
    "WGS84, of a geodetic system": (2112, b'GEODCRS["WGS 84",CS[ellipsoidal,2]]'),
    "geocentric": (2112, b'GEODCRS["WGS 84",CS[Cartesian,3]]'),
    "UTM": (2112, UTM),
    "keys of WGS84": (34735, struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 2, 2048, 0, 1, 4326)),
    "keys of UTM": (34735, struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32632)),
    "a part of keys": (34735, b"\1\0\1"),
}


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("is_extended", [False, True])
@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize(("scale", "east"), [(1e-6, 9.2), (1e-6, 400.0), (1e-3, 9.2)])
def test_longitude_and_latitude_are_refused_where_a_record_and_the_numbers_say_so(
    system: str, scale: float, east: float, is_extended: bool, suffix: str, tmp_path: Path
) -> None:
    number, said = SYSTEMS[system]
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [scale, scale, 1e-3]
    if is_extended and number == 2112:  # the keys of before 1.4 are in no extended record
        header.evlrs = laspy.vlrs.vlrlist.VLRList()
        header.evlrs += [laspy.VLR("straightpcf", 1, "", b"before"), laspy.VLR("LASF_Projection", number, "", said)]
    else:
        header.vlrs.append(laspy.VLR("LASF_Projection", number, "", said))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = torus(N).T * 1e-3 + [[east], [48.8], [0]]
    cloud.write(path := tmp_path / f"a{suffix}")
    if "WGS84" in system and (scale, east) == (1e-6, 9.2):
        with pytest.raises(UnsupportedCloud, match=r"x and y are degrees.*project the points first"):
            read_cloud(path)
    else:
        assert len(read_cloud(path)[0]) == N
