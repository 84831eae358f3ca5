"""One weight per entry of a block, or one per entry of all blocks: the paper's β and the authors' (chapter 07)."""

from functools import partial

from .lab import scoring

QUESTION = "Is the code better read off the last blocks by the paper's six shared weights, or by a full linear map?"

cases = partial(scoring.variants, "beta", ("full", "shared"), 3)
conditions = partial(scoring.variant_conditions, "beta")
measure = scoring.score_variant
report = partial(scoring.compare_variants, "beta")
