"""Soft threshold or ReLU: the paper's appendix finds no discernible difference (chapter 09)."""

from functools import partial

from .lab import scoring

QUESTION = "Does the soft threshold, which the paper derives, do better or worse than the ReLU that it runs?"

cases = partial(scoring.variants, "threshold", ("relu", "soft"), 5)
conditions = partial(scoring.variant_conditions, "threshold")
measure = scoring.score_variant
report = partial(scoring.compare_variants, "threshold")
