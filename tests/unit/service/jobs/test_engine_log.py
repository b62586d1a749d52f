"""What the durable engine logs of itself."""

import logging

from loopwright.service.jobs.dbos_engine import without_traceback

TEXT = """Exception polling schedules: Traceback (most recent call last):
  File "engine/base.py", line 154, in __init__
sqlalchemy.exc.OperationalError: the server closed the connection
(Background on this error at: there)
"""


def test_a_traceback_in_the_text_is_not_printed() -> None:
    record = logging.LogRecord("dbos", logging.WARNING, "engine", 1, TEXT, None, None)
    assert without_traceback(record)
    expected = "Exception polling schedules: sqlalchemy.exc.OperationalError: the server closed the connection"
    assert record.getMessage() == expected


def test_another_message_stays() -> None:
    record = logging.LogRecord("dbos", logging.WARNING, "engine", 1, "%d jobs wait", (3,), None)
    assert without_traceback(record)
    assert record.getMessage() == "3 jobs wait"
