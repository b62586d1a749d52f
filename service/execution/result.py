"""The result of a retune, made from the proposal of a procedure."""

from __future__ import annotations

from loopwright.service.jsonable import json_object
from loopwright.service.results import RESULT, FastResult, FiveStageResult, VerificationView
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.five_stage.procedure import Proposal


def result_of(proposal: Proposal | FastProposal) -> FastResult | FiveStageResult:
    """Returns the proposal under the names of the service; a number that is not finite is null."""
    fields = json_object(proposal)
    fields |= {
        "design": fields.pop("chosen"),
        "new_gains": fields.pop("gains"),
        "step_after": fields.pop("verification"),
    }
    if isinstance(proposal, Proposal):
        return RESULT.validate_python({**fields, "procedure": "five-stage", "step_before": fields["baseline"]})
    verified = fields.pop("verified")
    verification = VerificationView.of_stage(verified) if isinstance(verified, dict) else None
    found = {"procedure": "fast", "evidence": fields["found"], "verification": verification}
    return RESULT.validate_python(fields | found)
