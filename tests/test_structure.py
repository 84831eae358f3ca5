"""What the whole package keeps to: who knows whom, how often images are parsed, what the public surface looks like."""

import ast
import dataclasses
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nrsfm_lite as nl
from nrsfm_lite import images
from tests import count_calls

PACKAGE = Path(nl.__file__).parent

# Who may know whom. A module knows those of the floors below its own, except where `_LESS` says less; on a floor
# nobody knows a neighbour, except in `_ORDERED`, where each may know those before it.
_FLOORS = (
    ("checks", "threads"),
    ("data", "sparse_coding", "cameras", "metrics"),
    ("image_prior", "normalizer", "images", "gaussian", "shape_prior", "weights", "model", "gradient"),
    ("training", "datasets", "baselines", "quality"),
    ("reconstruction",),
    ("plotting",),
    ("experiments",),
    ("cli",),
)
_ORDERED = _FLOORS[2]
_LESS = {
    **{name: {"checks"} for name in _FLOORS[1]},
    "reconstruction": {name for floor in _FLOORS[:4] for name in floor} - {"datasets"},
    "plotting": {"checks", "data", "cameras", "metrics", "images"},
}
# A folder counts as one module; its files may know each other. Only this folder has floors of its own.
_LABORATORY = "experiments.lab"


def allowed() -> dict[str, set[str]]:
    """Module -> those that it may know."""
    below, result = set(), {}
    for floor in _FLOORS:
        for place, name in enumerate(floor):
            neighbours = set(floor[:place]) if floor is _ORDERED else set()
            result[name] = _LESS.get(name, below | neighbours)
        below |= set(floor)
    for name in result:
        if name not in ("experiments", "cli"):
            result[name] = result[name] - {"plotting"}
    return result


def modules() -> dict[str, Path]:
    """Dotted name within the package -> file; a folder's name leads to its __init__."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    del found[""]  # the package itself: it knows all, and loads them on first use
    return found


class _Imports(ast.NodeVisitor):
    """Every import of one file, wherever it stands, but for those that only type checkers see."""

    def __init__(self, name: str, path: Path, known: dict[str, Path]) -> None:
        self.name, self.known, self.found = name, known, set()
        folder = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
        self.folder = [PACKAGE.name, *folder]
        self.visit(ast.parse(path.read_text(encoding="utf-8")))

    def visit_If(self, node: ast.If) -> None:
        if "TYPE_CHECKING" not in ast.unparse(node.test):
            self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._add(alias.name)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        base = self.folder[: len(self.folder) - node.level + 1] if node.level else []
        base = ".".join([*base, *([node.module] if node.module else [])])
        for alias in node.names:
            self._add(f"{base}.{alias.name}")

    def _add(self, path: str) -> None:
        root, _, path = path.partition(".")
        if root != PACKAGE.name:
            return
        while path and path not in self.known:
            path = path.rpartition(".")[0]  # a name within a module
        while path:
            if not f"{self.name}.".startswith(f"{path}."):  # the folder that a file lies in is loaded already
                self.found.add(path)
            path = path.rpartition(".")[0]  # who imports a.b runs a's __init__, too


def arrows() -> dict[str, set[str]]:
    """Module -> those that it imports, within the package."""
    known = modules()
    return {name: _Imports(name, path, known).found for name, path in known.items()}


def test_every_module_has_a_place():
    places = allowed()
    top = {name.split(".")[0] for name in modules()}
    assert top <= places.keys(), f"no place in the table of this test: {', '.join(sorted(top - places.keys()))}"


def test_arrows_point_one_way():
    places = allowed()
    wrong = []
    for name, targets in arrows().items():
        top = name.split(".")[0]
        for target in sorted(targets):
            other = target.split(".")[0]
            if other != top and other not in places.get(top, set()):
                wrong.append(f"{name} -> {target}")
            if name.startswith(_LABORATORY) and other == top and not target.startswith(_LABORATORY):
                wrong.append(f"{name} -> {target}")
    assert not wrong, f"{len(wrong)} arrows against the design:\n" + "\n".join(wrong)


def test_there_is_no_circle():
    graph = arrows()
    # Whatever neither leads to a leaf nor comes from a root lies on a circle, or between two.
    while True:
        known = {target for targets in graph.values() for target in targets}
        left = {n: targets & graph.keys() for n, targets in graph.items() if n in known and targets & graph.keys()}
        if left == graph:
            break
        graph = left
    assert not graph, "circles of imports:\n" + "\n".join(f"{n} -> {', '.join(sorted(t))}" for n, t in graph.items())


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import nrsfm_lite as nl; dir(nl)", "torch scipy matplotlib plotly tqdm psutil"),
        ("import nrsfm_lite as nl; nl.experiments.NAMES", "torch scipy matplotlib plotly"),
        ("import nrsfm_lite as nl; nl.reconstruct; nl.baselines", "matplotlib plotly scipy.stats onnx"),
    ],
    ids=["import", "names of experiments", "reconstruct"],
)
def test_nothing_is_loaded_before_it_is_used(code, heavy):
    code += "; import sys; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(heavy.split()) & set(done.stdout.split())
    assert not loaded, f"loaded: {', '.join(sorted(loaded))}"


def test_names_that_load_on_first_use():
    assert set(nl.__all__) <= set(dir(nl))
    for name in nl.__all__:
        assert getattr(nl, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = nl.nothing
    assert not hasattr(nl, "_nothing")


def test_the_counter_sees_a_call_under_any_name():
    parse = images.parse
    counts = count_calls.count(lambda: parse(np.random.default_rng(0).normal(size=(3, 4, 2))))
    assert counts == {"parse": 1, "check_visible_finite": 1}


def test_images_are_parsed_once():
    wrong = []
    for name, counts in count_calls.table().items():
        if counts["parse"] != 1:
            wrong.append(f"{name} parses {counts['parse']} times; expected once")
        if name != "scores" and counts["center"] > 2:
            wrong.append(f"{name} centres {counts['center']} times; expected at most twice")
    assert not wrong, "\n".join(wrong)


def public() -> dict[str, object]:
    """Dotted name -> public function or class."""
    places = [nl, *(getattr(nl, name) for name in nl.__all__ if inspect.ismodule(getattr(nl, name)))]
    found = {}
    for place in places:
        own = place.__name__
        names = getattr(place, "__all__", [n for n in vars(place) if not n.startswith("_")])
        for name in names:
            value = getattr(place, name)
            if callable(value) and getattr(value, "__module__", "").startswith(own):
                found[f"{own.replace(PACKAGE.name, 'nl', 1)}.{name}"] = value
    return found


def faults_of_signature(function: object) -> list[str]:
    """What its annotations and the kinds of its parameters lack."""
    signature = inspect.signature(function)
    faults = []
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    bare = [p.name for p in parameters if p.annotation is p.empty]
    if bare:
        faults.append(f"without annotation: {', '.join(bare)}")
    if signature.return_annotation is inspect.Signature.empty:
        faults.append("without annotation of what it returns")
    by_place = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(by_place) > 3:
        faults.append(f"{len(by_place)} positional parameters; expected at most 3")
    return faults


def test_public_functions_are_annotated_and_show_an_example():
    faults = []
    for name, function in public().items():
        if inspect.isclass(function):
            continue
        faults += [f"{name}: {fault}" for fault in faults_of_signature(function)]
        if ">>> " not in (inspect.getdoc(function) or ""):
            faults.append(f"{name}: no example (>>>) in its docstring")
    assert not faults, f"{len(faults)} faults of the public surface:\n" + "\n".join(faults)


def test_public_dataclasses_are_annotated():
    faults = []
    for name, cls in public().items():
        if not (inspect.isclass(cls) and dataclasses.is_dataclass(cls)):
            continue
        faults += [f"{name}.{f.name}: without annotation" for f in dataclasses.fields(cls) if not f.type]
        own = {n: v for n, v in vars(cls).items() if not n.startswith("_")}
        for key, value in own.items():
            function = value.fget if isinstance(value, property) else getattr(value, "func", value)
            function = getattr(function, "__func__", function)  # of class and static methods
            if inspect.isfunction(function):
                faults += [f"{name}.{key}: {fault}" for fault in faults_of_signature(function)]
    assert not faults, f"{len(faults)} faults of public dataclasses:\n" + "\n".join(faults)
