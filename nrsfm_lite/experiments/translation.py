"""The 4×2 model on images with translations, beside the 3×2 model on centred ones (chapter 13)."""

from .lab import scoring

QUESTION = "Where does the 4x2 model, which takes the images uncentred, do as well as the 3x2 model on centred ones?"
_SHIFTS = (0.0, 1.0, 4.0)


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, model, share of hidden points, largest translation in sizes of the object, and seed."""
    if quick:
        rows = [("3x2", 0.1, 0.0, 0), ("4x2", 0.1, 1.0, 0), ("4x2, zeros", 0.1, 1.0, 0)]
    else:
        each = [("3x2", 0.0, 0.0), ("3x2", 0.1, 0.0), ("4x2", 0.0, 1.0)]
        each += [("4x2", 0.1, s) for s in _SHIFTS] + [("4x2, zeros", 0.1, 1.0)]
        rows = [(*row, seed) for seed in range(3) for row in each]
    data = "motion-small" if quick else "martial"
    return [{"data": data, "model": m, "hidden": h, "translation": t, "seed": s} for m, h, t, s in rows]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "3x2": "images centred over their visible points, which takes out any translation: one case stands for all",
        "4x2": "images as they are; the likely place for hidden points",
        "4x2, zeros": "images as they are; zeros for hidden points, as in the paper",
        "translation": "largest shift of an image per axis, in sizes of the object",
        "shift": "mean distance of the found translations from the true ones, in sizes of the object",
        "steps": scoring.QUICK_STEPS if quick else "the default schedule's",
    }


def measure(data: str, model: str, hidden: float, translation: float, seed: int) -> dict[str, object]:
    """Errors of one training."""
    fill = "zero" if model.endswith("zeros") else "likely"
    how = {"missing": hidden, "translation_range": translation}
    _, result = scoring.train_and_score(data, seed, how, translation=model != "3x2", fill=fill)
    return result


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line per model and kind of images."""
    return scoring.by_groups(("model", "hidden", "translation"), ("seen", "refined", "refined_unseen", "shift"), rows)
