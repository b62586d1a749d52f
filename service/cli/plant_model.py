"""A user's own plant for `loopwright plant`: a model in any form, in place of the name of one of the catalogue."""

from __future__ import annotations

import json
from collections.abc import Sequence

from loopwright.service.cli.output import die, model_object
from loopwright.service.inputs.model_json import BadModel, parse_model

OPERATING_POINT = ("mv", "pv")
"""Names of the operating point beside the model: MV in percent, PV in PV units."""
MORE = ("second_path", "valve", "sine")
"""Names of what else a plant can have, which the plant process checks."""
_OPTION = "--model"


def with_own_plants(arguments: Sequence[str]) -> list[str]:
    """Returns the arguments of the plant process, in which each model is a name or a transfer function.

    A model that is a JSON object, or a file with one, may have any form that `loopwright tune` takes; the gain is in PV
    units per percent of MV. Ends the command with status 2 where it is no model.
    """
    found: list[str] = []
    for argument in arguments:
        option, equals, value = argument.partition("=")
        if found and found[-1] == _OPTION:
            found.append(_transfer_function(argument))
        elif option == _OPTION and equals:
            found += [_OPTION, _transfer_function(value)]
        else:
            found.append(argument)
    return found


def _transfer_function(given: str) -> str:
    """Returns the model as a transfer function in JSON; the name of a plant of the catalogue as it is."""
    typed = given.lstrip().startswith("{") or "=" in given
    if not typed and not given.endswith(".json"):
        return given
    source, data = _OPTION if typed else given, model_object(given, _OPTION)
    point = {name: data.pop(name) for name in (*OPERATING_POINT, *MORE) if name in data}
    try:
        model = parse_model(data)
    except BadModel as error:
        die(f"{source}: {error}", 2)
    return json.dumps({"num": model.num, "den": model.den, "dead_time_s": model.L, **point})
