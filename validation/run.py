"""All five papers, in the order of the project's methods."""

from __future__ import annotations

from validation import direct_synthesis, five_stage, imc, me_pso, s_plane
from validation.checks import Paper
from validation.references import References


def validate(references: References) -> list[Paper]:
    """Results only: nothing is written."""
    return [module.check(references) for module in (five_stage, direct_synthesis, imc, s_plane, me_pso)]
