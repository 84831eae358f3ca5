"""Soft threshold or ReLU: the paper's appendix finds no discernible difference (chapter 09)."""

from functools import partial

from . import material

QUESTION = "Does the soft threshold, which the paper derives, do better or worse than the ReLU that it runs?"

cases = partial(material.variants, "threshold", ("relu", "soft"), 5)
conditions = partial(material.variant_conditions, "threshold")
measure = material.score_variant
report = partial(material.compare_variants, "threshold")
