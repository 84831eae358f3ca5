"""The runner: every case once, provenance, and going on after an interruption."""

import csv
import json
import types

import pytest

from nrsfm_lite import cli, experiments
from nrsfm_lite.experiments.lab import runner, scoring


@pytest.fixture
def toy(monkeypatch):
    """An experiment of four cases that counts how often it is asked."""
    asked = []

    def measure(data, seed):
        asked.append(seed)
        if seed == 2 and len(asked) == 3:
            raise KeyboardInterrupt
        return {"square": float(seed**2)}

    module = types.SimpleNamespace(
        QUESTION="What are the squares?",
        cases=lambda quick: [{"data": "motion-small", "seed": s} for s in range(2 if quick else 4)],
        conditions=lambda quick: {"power": 2},
        measure=measure,
        report=lambda rows: f"{len(rows)} rows",
        asked=asked,
    )
    monkeypatch.setattr(runner.importlib, "import_module", lambda name, package: module)
    return module


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_an_interrupted_experiment_goes_on_where_it_was(toy, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        experiments.run("speed", folder=tmp_path, say=lambda line: None)
    assert [r["seed"] for r in read(tmp_path / "speed.csv")] == ["0", "1"]
    lines = []
    rows = experiments.run("speed", folder=tmp_path, say=lines.append)
    assert toy.asked == [0, 1, 2, 2, 3]
    assert [r["square"] for r in rows] == ["0", "1", "4", "9"] == [r["square"] for r in read(tmp_path / "speed.csv")]
    assert lines[-1] == "4 rows" and "left" in lines[-2]
    assert not list(tmp_path.glob("*.part"))


def test_provenance(toy, tmp_path):
    toy.asked.extend([9, 9, 9])  # no interruption
    experiments.run("speed", folder=tmp_path, say=lambda line: None)
    origin = json.loads((tmp_path / "speed.json").read_text())
    assert origin["conditions"] == {"power": 2} and origin["command"] == "nrsfm experiment speed"
    assert origin["data"]["motion-small"] == scoring.describe("motion-small")
    (run,) = origin["runs"]
    assert run["rows"] == 4 and {"started", "commit", "device", "versions", "seconds"} <= run.keys()
    assert run["versions"]["torch"]


def test_a_table_of_something_else_is_left_alone(toy, tmp_path):
    (tmp_path / "speed.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="other columns"):
        experiments.run("speed", folder=tmp_path)
    assert (tmp_path / "speed.csv").read_text() == "a,b\n1,2\n"


def test_unknown_names_are_refused(capsys):
    with pytest.raises(KeyError, match="unknown experiment 'x'"):
        experiments.run("x")
    with pytest.raises(SystemExit):
        cli.main(["experiment", "x"])
    capsys.readouterr()


def test_a_case_may_give_several_rows(toy, tmp_path):
    toy.measure = lambda data, seed: [{"square": seed**2 + i} for i in range(3)]
    runner.run("speed", folder=tmp_path, say=lambda line: None)
    rows = read(tmp_path / "speed.csv")
    assert [r["square"] for r in rows[3:6]] == ["1", "2", "3"] and len(rows) == 12
    assert len(runner.run("speed", folder=tmp_path, say=lambda line: None)) == 12  # nothing is measured again


def test_what_names_a_case_is_not_overwritten(toy, tmp_path):
    toy.measure = lambda data, seed: {"square": seed**2, "seed": 0.5}
    with pytest.raises(ValueError, match="measured seed, which is what names the case"):
        runner.run("speed", folder=tmp_path, say=lambda line: None)


@pytest.mark.parametrize("name", experiments.NAMES)
def test_the_quick_form_of_every_experiment_runs(name, tmp_path, capsys):
    assert cli.main(["experiment", name, "--quick", "--out", str(tmp_path)]) == 0
    assert read(tmp_path / f"{name}.csv") and (tmp_path / f"{name}.json").exists()
    assert capsys.readouterr().out
