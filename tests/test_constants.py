"""The table of the filter's constants in docs/filter.md, beside the code and the weights that ship."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from numbers import Number
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.checkpoint import read_checkpoint
from straightpcf.model.filter import DEFAULT_WEIGHTS

ROOT = Path(__file__).parents[1]
MODEL = ROOT / "model"
FILES = sorted(str(path.relative_to(MODEL)) for path in [*MODEL.glob("*.py"), *MODEL.glob("nets/*.py")])
# What decides nothing about a result: memory and time, a file's format, rounding, or another name's consequence.
NOT_TUNED = {
    "agreement.py": {"_LEAST_DISTANCE", "_STEPS"},
    "allocator.py": {"_M_TRIM_THRESHOLD", "_M_TOP_PAD", "_M_MMAP_THRESHOLD", "_LARGEST_THRESHOLD", "_KEPT", "_PAD"},
    "checkpoint.py": {"MAX_COUPLINGS", "MAX_WIDTH", "MAX_OFFICIAL_BYTES"},
    "cpus.py": {"_IMPORTED_IN"},  # a process
    "device_patches.py": {"_DISTANCES"},
    "distinct.py": {"_GOLDEN", "_BLOCK"},
    "low_noise.py": {"_FIT_TERMS", "_RIDGE"},  # a quadric's six
    "metrics.py": {"PAIRS_AT_ONCE", "FIRST_NEIGHBOURS", "SLIVER"},
    "neighbourhoods.py": {"_LEAST_RADIUS"},
    "normalize.py": {"_BLOCK"},
    "normals.py": {"_CHUNK"},
    "on_device.py": {"_BATCH", "_ASKED", "_ROWS", "_MOST_GRAPHS", "_IN_FLIGHT", "_MOST_THREADS"},
    "ops.py": {"_DIRECT"},
    "objects.py": {"_BLOCK"},
    "outliers.py": {"_BLOCK"},
    "patches.py": {"_TREE_HEIGHT"},
    "planes.py": {"_PLANE_FREEDOM"},
    "restraint.py": {"_LINE_FREEDOM"},  # of a mean and a direction
    "run.py": {"_HEARD", "_MOVED", "_NOTHING"},
    "spread.py": {"_CHUNKS", "_TINY"},
    "survey.py": {"_TOGETHER"},
    "views.py": {"_LEAST", "_STD_OF_MEDIAN", "_RIDGE", "_NOWHERE"},
    "turns.py": {"_PSI"},  # a root that the paper gives
}


def rows() -> list[tuple[str, str, Any]]:
    """Return name, file and value of every constant that the table lists."""
    section = (ROOT / "docs/filter.md").read_text().split("\n## Constants\n")[1].split("\n## ")[0]
    found = []
    for line in re.findall(r"^\| (`.*) \|$", section, re.MULTILINE):
        names, file, values, *_ = line.split(" | ")
        parsed = eval(f"[{values}]", {"__builtins__": {}})  # 1 / 3 is no literal
        found += [(name, file.strip("`"), value) for name, value in zip(names.split(", "), parsed, strict=True)]
    return [(name.strip("`"), file, value) for name, file, value in found]


def numbers(file: str) -> Iterator[str]:
    """Yield the names in capitals that a module gives a number, or several."""
    module = module_of(file)
    statements = ast.parse((MODEL / file).read_text()).body
    assigned = (node for each in statements if isinstance(each, ast.Assign | ast.AnnAssign) for node in ast.walk(each))
    for name in (node.id for node in assigned if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)):
        if name.isupper() and isinstance(getattr(module, name), Number | tuple | dict):
            yield name


def module_of(file: str) -> ModuleType:
    return importlib.import_module("straightpcf.model." + file.removesuffix(".py").replace("/", "."))


@pytest.mark.parametrize(("name", "file", "value"), rows())
def test_a_constant_has_the_value_that_the_guide_says(name: str, file: str, value: object) -> None:
    if file == "weights/":
        assert getattr(Calibration.from_metadata(read_checkpoint(DEFAULT_WEIGHTS)[1]), name) == value
    else:
        assert getattr(module_of(file), name) == value


@pytest.mark.parametrize("file", FILES)
def test_every_tuned_constant_is_in_the_table(file: str) -> None:
    listed = {name for name, of, _ in rows() if of == file}
    exempt = NOT_TUNED.get(file, set())
    assert set(numbers(file)) == listed | exempt
    assert not listed & exempt
