"""The samples of a job as streamed JSON or CSV text, in parts of bounded size, read block by block.

A job of days has millions of samples; neither they nor their text are ever in memory together. JSON has a list for each
column, so the blocks are read once for each column.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from loopwright.service.store.sample_blocks import COLUMNS, Block

if TYPE_CHECKING:  # a report is computed without the store
    from loopwright.service.store.store import Store

_PART = 1 << 16
"""Characters of a part that is handed to the server."""
_GZIP_LEVEL = 4
_NO_NUMBERS = frozenset({"nan", "inf", "-inf"})


class Gone(Exception):
    """Samples were deleted while they were read. The answer is cut off, so the client does not take it for complete."""


class Reading:
    """The samples that a job has now, of one stage or of all. They can be read more than once; later samples are left
    out."""

    def __init__(self, store: Store, job_id: str, stage: str | None = None) -> None:
        self.job_id = job_id
        self._store, self._stage = store, stage
        self._last = store.last_block(job_id)
        self._count: int | None = None

    @property
    def etag(self) -> str:
        """What changes when samples come: the tag of an answer with these samples. Weak: they may be compressed."""
        of = f"{self.job_id} {self._stage} {self._last}".encode()
        return f'W/"{hashlib.sha256(of).hexdigest()[:16]}"'

    def blocks(self) -> Iterator[Block]:
        """The blocks in order. Raises Gone when the number of samples differs from the previous pass."""
        count = 0
        for block in self._store.blocks(self.job_id, self._stage, self._last):
            count += block.count
            yield block
        if self._count not in (None, count):
            raise Gone(f"samples of job {self.job_id} were deleted while they were read")
        self._count = count


def json_text(of: Reading) -> Iterator[str]:
    """The JSON object that GET /jobs/{id}/samples answers with."""
    yield f'{{"job":{json.dumps(of.job_id)}'
    for column in ("stage", *COLUMNS):
        yield f',"{column}":['
        comma = ""
        for block in of.blocks():
            yield comma + ",".join(_json_values(block, column))
            comma = ","
        yield "]"
    yield "}"


def _json_values(block: Block, column: str) -> Iterable[str]:
    if column == "stage":
        return [json.dumps(block.stage)] * block.count
    texts = block.texts(column)
    return ["null" if text in _NO_NUMBERS else text for text in texts] if column != "mode" else texts


def csv_text(blocks: Iterable[Block]) -> Iterator[str]:
    """CSV text: a header, then a row for each sample."""
    yield ",".join(("stage", *COLUMNS)) + "\n"
    for block in blocks:
        columns = (block.texts(column) for column in COLUMNS)
        rows = zip([block.stage] * block.count, *columns, strict=True)
        yield "".join(",".join(row) + "\n" for row in rows)


def parts(text: Iterator[str], compress: bool) -> Iterator[bytes]:
    """The text as bytes in parts of about 64 kB, compressed with gzip if asked."""
    if not compress:
        yield from (part.encode() for part in _gathered(text))
        return
    packer = zlib.compressobj(_GZIP_LEVEL, wbits=31)  # 31 selects the gzip format
    for part in _gathered(text):
        if packed := packer.compress(part.encode()):
            yield packed
    yield packer.flush()


def _gathered(text: Iterator[str]) -> Iterator[str]:
    waiting: list[str] = []
    length = 0
    for piece in text:
        waiting.append(piece)
        length += len(piece)
        if length >= _PART:
            yield "".join(waiting)
            waiting, length = [], 0
    if waiting:
        yield "".join(waiting)
