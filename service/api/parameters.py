"""Query parameters that an operation does not have are refused: a misspelled one would be ignored without a word."""

from __future__ import annotations

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Query
from starlette.exceptions import HTTPException

from loopwright.service.inputs.validation import did_you_mean


class UnknownParameter(HTTPException):
    """The request has a query parameter that the operation does not have. where: its path."""

    def __init__(self, name: str, known: list[str]) -> None:
        has = f"the parameters are {', '.join(known)}" if known else "there are none"
        super().__init__(422, f"there is no such query parameter{did_you_mean(name, known)}; {has}")
        self.where = f"query.{name}"


def parameters_of(dependant: Dependant) -> list[str]:
    """Returns the names of the query parameters of an operation."""
    return sorted(each.alias for each in get_flat_params(dependant) if isinstance(each.field_info, Query))


def refuse_others(request: Request, known: list[str]) -> None:
    """Raises UnknownParameter for the first query parameter that is not among the known ones."""
    for name in request.query_params:
        if name not in known:
            raise UnknownParameter(name, known)
