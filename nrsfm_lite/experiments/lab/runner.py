"""Runs an experiment case by case and keeps what it measured, with all that is needed to trust it.

An experiment is a module of `nrsfm_lite.experiments` with

    QUESTION               one sentence: what is asked
    cases(quick)           list of dicts: all that decides a row, such as data, setting and seed
    measure(**case)        dict of what was measured for one case, or a list of them for several rows
    conditions(quick)      dict of what all cases share; it goes into the provenance
    report(rows)           a few lines of text for people

and the runner makes NAME.csv, one row per measurement, and NAME.json, where the rows come from.
"""

import csv
import importlib
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

NAMES = (
    *("speed", "inference", "thresholds", "relaxation", "training", "coherence", "stress", "unseen"),
    *("missing", "translation", "noise", "classic", "growth", "starts", "defaults", "films"),
)
_LIBRARIES = ("torch", "numpy", "scipy")
_EXPERIMENTS = __package__.rpartition(".")[0]


def run(
    name: str, *, quick: bool = False, folder: str | Path | None = None, say: Callable[[str], object] = print
) -> list[dict[str, str]]:
    """Do what is left of an experiment, and return all its rows.

    Every finished case is written at once, whole or not at all, so a run may be stopped at any time
    and goes on where it was. Rows of the same case are never measured twice: remove the CSV to start anew.

    Parameters
    ----------
    name : str
        One of ``experiments.NAMES``.
    quick : bool
        A minute of the same, at a size that shows that it works and says nothing about the question.
    folder : path, optional
        Where the two files go. Default: ``results``; of a quick run ``_build/results``.
    say : callable
        Takes one line of progress.

    Returns
    -------
    list of dicts, in the order of the experiment's cases; all values are strings.

    Raises
    ------
    KeyError
        For an unknown name.
    ValueError
        If the CSV in the folder has other columns.
    FileNotFoundError
        If real data is needed and not there.

    Examples
    --------
    >>> rows = nl.experiments.run("stress", quick=True)  # doctest: +SKIP
    """
    if name not in NAMES:
        raise KeyError(f"unknown experiment {name!r}; there are {', '.join(NAMES)}.")
    experiment = importlib.import_module(f".{name}", _EXPERIMENTS)
    asked = experiment.cases(quick)
    cases = [{key: _text(value) for key, value in case.items()} for case in asked]
    folder = Path(folder or ("_build/results" if quick else "results"))
    table, origin = folder / f"{name}.csv", folder / f"{name}.json"
    rows = _read(table, cases)
    done = _keys(rows, cases)
    todo = [(key, case) for key, case in zip(cases, asked, strict=True) if key not in done]
    say(f"{name}: {experiment.QUESTION}")
    say(f"{len(cases)} cases, {len(cases) - len(todo)} done before, results in {table}")
    folder.mkdir(parents=True, exist_ok=True)
    this_run = _circumstances()
    start = time.perf_counter()
    for n, (key, case) in enumerate(todo, 1):
        begun = time.perf_counter()
        measured = experiment.measure(**case)
        seconds = {"seconds": _text(time.perf_counter() - begun)}
        several = measured if isinstance(measured, list) else [measured]
        if taken := {k for m in several for k in m} & key.keys():
            raise ValueError(f"{name}: measured {', '.join(sorted(taken))}, which is what names the case.")
        added = [{**key, **{k: _text(v) for k, v in m.items()}, **seconds} for m in several]
        rows += added
        rows.sort(key=lambda r: _place(r, cases))
        _write_table(table, rows)
        passed = time.perf_counter() - start
        this_run |= {"rows": n, "seconds": round(passed)}
        _write_origin(origin, name, experiment, quick, rows, this_run)
        left = passed / n * (len(todo) - n)
        say(f"{n}/{len(todo)} {', '.join(added[-1].values())} · {_duration(left)} left")
    say(experiment.report(rows))
    return rows


def _keys(rows, cases):
    return [{k: r[k] for k in cases[0]} for r in rows]


def _place(row, cases):
    """Where a row belongs; rows of cases that this machine does not have, such as a GPU's, come last."""
    key = {k: row[k] for k in cases[0]}
    return cases.index(key) if key in cases else len(cases)


def _read(table, cases):
    if not table.exists():
        return []
    with open(table, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if rows and not set(cases[0]) <= set(rows[0]):
        raise ValueError(f"{table}: has other columns than this experiment; move it away to start anew.")
    return rows


def _write_table(path, rows):
    part = path.with_name(path.name + ".part")
    with open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[-1]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(part, path)


def _write_origin(path, name, experiment, quick, rows, this_run):
    """Where the rows come from: conditions, data and their hashes, and every run that added some."""
    from . import scoring  # here: whoever only asks for the names of the experiments must not wait for PyTorch

    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    runs = [r for r in before.get("runs", []) if r["started"] != this_run["started"]]
    data = sorted({row["data"] for row in rows if "data" in row})
    origin = {
        "experiment": name,
        "question": experiment.QUESTION,
        "command": f"nrsfm experiment {name}" + (" --quick" if quick else ""),
        "conditions": experiment.conditions(quick),
        "data": {d: scoring.describe(d) for d in data},
        "runs": [*runs, this_run],
    }
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(origin, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    os.replace(part, path)


def _circumstances():
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "device": device_name(),
        "versions": {"python": platform.python_version(), **{lib: version(lib) for lib in _LIBRARIES}},
    }


def device_name() -> str:
    """The processor and, if there is one, the GPU, in words."""
    import torch  # here for the same reason as in `_write_origin`

    name = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0] if models else name
    name = f"{name}, {os.cpu_count()} cores"
    return f"{name}; {torch.cuda.get_device_name()}" if torch.cuda.is_available() else name


def _commit():
    """The checkout's commit, with '+' if files have changed since; None outside a checkout."""
    package = Path(__file__).parents[2]

    def git(*words):
        return subprocess.run(["git", *words], cwd=package, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _text(value):
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _duration(seconds):
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s"
