"""The result of a retune, made from the proposal of a procedure."""

from __future__ import annotations

from typing import Any

from loopwright.service.jsonable import to_jsonable
from loopwright.service.results import RESULT, FastResult, FiveStageResult, VerificationView
from loopwright.tuning.fast.proposal import FastProposal
from loopwright.tuning.five_stage.procedure import Proposal


def result_of(proposal: Proposal | FastProposal) -> FastResult | FiveStageResult:
    """The proposal under the names of the service; a number that is not finite is null."""
    told: dict[str, Any] = to_jsonable(proposal)
    told |= {"new_gains": told.pop("gains"), "after": told.pop("verification")}
    if isinstance(proposal, Proposal):
        return RESULT.validate_python({**told, "procedure": "five-stage", "before": told["baseline"]})
    verified = told.pop("verified")
    told["verification"] = None if verified is None else VerificationView.of_stage(verified)
    return RESULT.validate_python({**told, "procedure": "fast", "evidence": told["found"]})
