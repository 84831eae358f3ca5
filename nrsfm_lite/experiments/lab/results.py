"""One door to the recorded results: the tables that the book's pictures are drawn from."""

import csv
from pathlib import Path

# An installed package has no results beside it. A notebook runs in its own folder, a shell in the repository's.
_PLACES = (Path(__file__).resolve().parents[3] / "results", Path("results"), Path("../results"))


def read_results(name: str, folder: str | Path | None = None) -> list[dict[str, str]]:
    """Read a recorded table: ``NAME.csv``, made by ``nrsfm experiment NAME``, or ``published``, others' numbers.

    Parameters
    ----------
    name : str
        The table's name, without ``.csv``.
    folder : path, optional
        Where the table lies. Default: the folder ``results`` of the repository that the package is used from;
        for an installed package ``results`` in or beside the current folder.

    Returns
    -------
    list of dicts, one per row in the order of the file: column -> cell. All cells are strings, an empty one is ``""``.

    Raises
    ------
    KeyError
        If the folder has no table of that name.
    FileNotFoundError
        If there is no such folder, or no table in it.

    Examples
    --------
    >>> rows = nl.experiments.read_results("speed")
    >>> sorted({row["device"] for row in rows})
    ['cpu']
    """
    places = _PLACES if folder is None else (Path(folder),)
    found = next((place for place in places if any(place.glob("*.csv"))), None)
    if found is None:
        looked = ", ".join(str(place) for place in places)
        raise FileNotFoundError(f"there is no folder of recorded results; looked for {looked}; give folder=.")
    table = found / f"{name}.csv"
    if not table.is_file():
        there = ", ".join(sorted(path.stem for path in found.glob("*.csv"))) or "none"
        raise KeyError(f"no recorded results {name!r} in {found}; there are {there}.")
    with open(table, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
