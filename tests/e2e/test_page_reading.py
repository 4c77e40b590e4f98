"""What the page reads of files itself, beside what the server reads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from straightpcf.points.formats import format_named, read_cloud
from tests.points.samples import SAMPLES
from tests.points.test_xyz import TABBED, TABLES
from tests.points.test_xyz_refused import GRIDS, MALFORMED, scanned

POSITIONS = "async ([b, name]) => [...(await import('/static/read/index.js')).readPositions(new Uint8Array(b), name)]"


def test_the_page_reads_text_tables_as_the_server_does(page: Any) -> None:
    read = "async (bytes) => [...(await import('/static/read/xyz.js')).readXyz(new Uint8Array(bytes))]"
    for case, raw in TABLES.items():
        assert page.evaluate(read, list(raw)) == [1, 2, 3, 4, 5, 6], case


def test_the_page_reads_every_suffix_of_text_tables(page: Any) -> None:
    for suffix in (suffix for name in ("xyz", "csv", "tsv", "pts") for suffix in format_named(name).suffixes):
        assert page.evaluate(POSITIONS, [list(b"1 2 3\n4 5 6\n"), f"A{suffix.upper()}"]) == [1, 2, 3, 4, 5, 6], suffix
        assert page.evaluate("async (n) => (await import('/static/read/reader.js')).canRead(n, 9)", f"a{suffix}"), (
            suffix
        )


def test_the_page_splits_a_tsv_at_its_tabs_as_the_server_does(page: Any) -> None:
    for case, raw in (TABBED | TABLES).items():
        assert page.evaluate(POSITIONS, [list(raw), "a.tsv"]) == [1, 2, 3, 4, 5, 6], case
    gaps = page.evaluate(POSITIONS, [list(b"x\ty\tz\n1\t2\t3\n\t\t\n4\t\t6\n"), "a.tsv"])
    np.testing.assert_array_equal(np.array(gaps, np.float64), [1, 2, 3, np.nan, np.nan, np.nan, 4, np.nan, 6])


def test_the_page_leaves_a_ptx_file_to_the_server_whatever_it_is_called(page: Any, tmp_path: Path) -> None:
    said = "async (a) => { try { return (await (%s)(a)).length } catch (error) { return error.message } }" % POSITIONS  # noqa: UP031
    raw = SAMPLES["ptx"](tmp_path).read_bytes()
    for name in ("a.ptx", "a.txt", "a.pts"):
        assert page.evaluate(said, [list(raw), name]) == "a format that this page does not read", name
    assert page.evaluate(said, [list(raw.partition(b"0 0 0 1\r\n")[2].partition(b"\r\n1\r\n")[0]), "a.txt"]) == 60


def test_the_page_reads_a_ply_with_capital_axes(page: Any, scan: Path, tmp_path: Path) -> None:
    for axis in b"xyz":
        scan.write_bytes(scan.read_bytes().replace(b"float %c\n" % axis, b"float %c\n" % (axis - 32)))
    read = page.evaluate(POSITIONS, [list(scan.read_bytes()), "a.ply"])
    np.testing.assert_array_equal(np.reshape(read, (-1, 3)), read_cloud(scan)[0].xyz)


def test_the_page_reads_a_ply_with_a_byte_order_mark(page: Any, scan: Path) -> None:
    scan.write_bytes(b"\xef\xbb\xbf" + scan.read_bytes())
    read = page.evaluate(POSITIONS, [list(scan.read_bytes()), "a.ply"])
    np.testing.assert_array_equal(np.reshape(read, (-1, 3)), read_cloud(scan)[0].xyz)


@pytest.mark.parametrize("separator", [" ", ",", "\t"])
def test_the_page_refuses_a_first_column_that_counts_the_points_as_the_server_does(page: Any, separator: str) -> None:
    said = "async (a) => { try { return (await (%s)(a)).length } catch (error) { return error.message } }" % POSITIONS  # noqa: UP031
    name = "a.tsv" if separator == "\t" else "a.txt"

    def answer(rows: list[str], above: str = "") -> Any:
        raw = "\n".join([above, *rows]).replace(" ", separator).encode()
        return page.evaluate(said, [list(raw), name])

    counted = [f"{n} {n % 7}.5 2 3.25 tree" for n in range(1, 51)]
    assert "counts the points" in answer(counted)
    assert answer(counted, "id x y z code") == 150
    assert answer([f"{n} 0 1" for n in range(50)]) == 150
    assert answer([f"{n} 0 1 oak" for n in range(50)]) == 150
    assert answer([f"{n % 10} {n // 10} 1 7" for n in range(50)]) == 150
    assert answer([f"{n + 0.5} 0 1 7" for n in range(50)]) == 150
    assert answer([f"{n} 0 1 7" for n in range(9)]) == 27
    assert answer([f"{2 * n} 0 1 7" for n in range(50)]) == 150


def test_the_page_refuses_a_scanners_rows_and_columns_as_the_server_does(page: Any) -> None:
    said = "async (a) => { try { return (await (%s)(a)).length } catch (error) { return error.message } }" % POSITIONS  # noqa: UP031
    for separator, name in ((" ", "a.txt"), (",", "a.csv"), ("\t", "a.tsv")):
        for more in ("", "0.5", "10 20 oak"):
            rows = scanned(separator, more)
            raw = "\n".join(rows).encode()
            assert "number rows and columns" in str(page.evaluate(said, [list(raw), name])), (separator, more)
            names = separator.join(["row", "column", "x", "y", "z", *"abc"[: len(more.split())]]).encode()
            assert page.evaluate(said, [list(names + b"\n" + raw), name]) == 3 * len(rows)
    for case, rows in GRIDS.items():
        assert page.evaluate(said, [list("\n".join(rows).encode()), "a.txt"]) == 3 * len(rows), case


def test_the_page_refuses_names_as_the_server_does(page: Any) -> None:
    """Rather no picture of what was sent than one of other columns."""
    read = "async (b) => (await import('/static/read/xyz.js')).readXyz(new Uint8Array(b))"
    said = "async (b) => { try { await (%s)(b) } catch (error) { return error.message } }" % read  # noqa: UP031
    for case in (case for case, (_, pattern) in MALFORMED.items() if "name" in pattern):
        assert page.evaluate(said, list(MALFORMED[case][0])) == "names that do not say x, y, z", case


def test_the_page_refuses_what_is_no_number_as_the_server_does(page: Any) -> None:
    """Numbers with decimal commas among it: between commas they would be points elsewhere."""
    said = "async (a) => { try { return (await (%s)(a)).length } catch (error) { return error.message } }" % POSITIONS  # noqa: UP031
    for case, (raw, pattern) in MALFORMED.items():
        if "no number" in pattern or "have a point" in pattern:
            assert re.search("is no number|no comma", str(page.evaluate(said, [list(raw), "a.txt"]))), case
    for row in ("1,2,3,4,5,6", "1, 2, 3, 4, 5, 6", "0,5, 1,5,2,5", "1,10,2,20,3,30"):
        assert page.evaluate(said, [list(f"{row}\n".encode() * 2), "a.csv"]) == 6, row
    assert page.evaluate(said, [list(b"1;;NULL\nna;nan;1.#IND\n"), "a.csv"]) == 6
