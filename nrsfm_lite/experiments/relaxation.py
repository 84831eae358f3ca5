"""One weight per entry of a block, or one per entry of all blocks: the paper's β and the authors' (chapter 07)."""

from functools import partial

from . import material

QUESTION = "Is the code better read off the last blocks by the paper's six shared weights, or by a full linear map?"

cases = partial(material.variants, "beta", ("full", "shared"), 3)
conditions = partial(material.variant_conditions, "beta")
measure = material.score_variant
report = partial(material.compare_variants, "beta")
