"""Routes for what is abnormal, and for signing it off."""

from __future__ import annotations

from typing import Annotated

from fastapi import Body, FastAPI, Path, Request
from fastapi.responses import JSONResponse

from loopwright.service.alarms.alarm import Alarm, AlarmList
from loopwright.service.alarms.watch import FRESH_S, AlarmWatch, NoSuchAlarm
from loopwright.service.api import problems
from loopwright.service.api.job_views import Decision, signed_by
from loopwright.service.api.routes import add, new_router

AlarmId = Annotated[str, Path(description="Id of the alarm", examples=["0f3ac2d9be11"])]


def install(app: FastAPI, watch: AlarmWatch) -> None:
    """Adds GET /alarms, GET /alarms/{id} and POST /alarms/{id}/sign-off."""
    router = new_router("alarms")

    @router.get("/alarms", summary="What is abnormal now, the worst first")
    def list_alarms() -> AlarmList:
        return AlarmList(alarms=list(watch.look(FRESH_S)))

    @router.get(
        "/alarms/{alarm_id}", summary="An alarm, also one that was signed off", responses=problems.responses(404)
    )
    def get_alarm(alarm_id: AlarmId) -> Alarm:
        return watch.find(alarm_id)

    @router.post(
        "/alarms/{alarm_id}/sign-off",
        summary="Sign an alarm off: a person answers for it, and it ends",
        responses=problems.responses(404, 409, 422),
    )
    def sign_off_alarm(alarm_id: AlarmId, decision: Annotated[Decision | None, Body()] = None) -> Alarm:
        return watch.sign_off(alarm_id, signed_by(decision))

    add(app, router)

    @app.exception_handler(NoSuchAlarm)
    async def _unknown(_request: Request, error: NoSuchAlarm) -> JSONResponse:
        return problems.problem(404, str(error), reason=problems.ProblemReason.UNKNOWN_ALARM)
