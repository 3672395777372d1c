"""A JPEG scan with a row of blocks more, so that libjpeg notices a wrong number of blocks.

A damaged bit seldom breaks a Huffman code for long: the decoder falls into step again, but a block or two more may have
come out, and all that follows is shifted. libjpeg stops when it has the blocks that it needs, and whatever is left over
is within the 64 bits that it has read ahead, of which it says nothing. With one row more below the picture, whose last
unit is longer than that, the surplus is always outside and libjpeg warns of it. The row is cut off again.

This needs the place where the last block ends. Mostly it does with an end-of-block code, behind which there are only
ones to fill the byte: as no code is all ones, their number tells it. For other files all places in the last byte are
tried; there, the row has to come out as it was written: its first unit is like its last, and no other is.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

_MARKER = re.compile(rb"\xff[^\x00]", re.DOTALL)  # within a scan, 0xff is followed by 0
_BASELINE, _TABLES, _SCAN, _RESTARTS, _END = (0xC0, 0xC1), 0xC4, 0xDA, 0xDD, b"\xff\xd9"
_LONG = 96  # bits: 64 that libjpeg reads ahead, the filling of a byte, and a byte that is left over
_HIGHEST = 65500  # rows that libjpeg reads
_BLOCK = 8  # px of a side
_WINDOW = 4  # bytes in which the last codes end


_Part = tuple[int, int, dict[int, str], dict[int, str]]


@dataclass(frozen=True)
class _Scan:
    """What is needed of the headers of a file with a single baseline scan.

    Attributes:
        start: where the bits of the scan begin.
        size_at: where the file has its height, 16 bits, then its width.
        height: px.
        width: px.
        parts: of each colour of a unit of the scan, the number of its blocks from left to right and from top to bottom,
            and its codes for DC and AC, as text of bits by symbol.
    """

    start: int
    size_at: int
    height: int
    width: int
    parts: list[_Part]


def with_row_below(data: bytes) -> Iterator[tuple[bytes, int]]:
    """The file with a row of units more, for each place where its last block may end, the likeliest first; and the
    column where the last unit begins.

    A whole file gives its picture and a row in one of them at least. There are none for files with several scans, with
    restart markers, which bound a shift, or with tables in which the row cannot be written.
    """
    scan = _read(data)
    end = None if scan is None else _MARKER.search(data, scan.start)
    if scan is None or end is None or end[0] != _END:
        return
    first = scan.parts[0]
    unit: list[_Part] = [(1, 1, first[2], first[3])] if len(scan.parts) == 1 else scan.parts
    across, down = max(part[0] for part in unit) * _BLOCK, max(part[1] for part in unit) * _BLOCK
    height = -(-scan.height // down) * down + 1
    count = -(-scan.width // across)
    row = _row(unit, count)
    cut = max(scan.start, end.start() - 2 * _WINDOW)
    cut += data[cut - 1 : cut + 1] == b"\xff\x00"
    last = "".join(f"{byte:08b}" for byte in data[cut : end.start()].replace(b"\xff\x00", b"\xff"))
    if not row or len(last) < 8 or height > _HIGHEST or scan.width < _BLOCK:
        return
    start = data[: scan.size_at] + height.to_bytes(2, "big") + data[scan.size_at + 2 : cut]
    close = unit[-1][3][0]
    likeliest = len(last) - len(last.rstrip("1")) - (len(close) - len(close.rstrip("1")))
    for filling in sorted(range(8), key=lambda count: count != likeliest):
        bits = last[: len(last) - filling] + row
        bits += "1" * (-len(bits) % 8)
        longer = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\x00")
        yield start + longer + data[end.start() :], (count - 1) * across


def is_whole(row: np.ndarray, last: int) -> bool:
    """Whether the row below came out as it was written: its first block is not flat, and the same as its last."""
    visible = min(_BLOCK, len(row) - last)
    return bool(np.ptp(row[:_BLOCK]) > 0 and (row[last : last + visible] == row[:visible]).all())


def _row(unit: list[_Part], count: int) -> str:
    """Bits of so many units: of nothing, but for the first and the last. Empty where the codes do not suffice."""
    if not all(0 in dc and 0 in ac for _, _, dc, ac in unit):
        return ""
    plain = "".join((dc[0] + ac[0]) * (across * down) for across, down, dc, ac in unit)
    _, _, dc, ac = unit[0]
    symbol = min((s for s in ac if 0 < s < 11), default=0)  # a coefficient of so many bits, no zeros before it
    if not symbol:
        return ""
    value = ac[symbol] + "1" * symbol + ac[symbol] + "0" * symbol  # up and down
    number = min(_BLOCK**2 // 2 - 1, -(-_LONG // len(value)))
    long = dc[0] + value * number + plain[len(dc[0]) :]
    return long * min(count, 2) if count < 3 else long + plain * (count - 2) + long


def _read(data: bytes) -> _Scan | None:
    """The headers, where the first scan is all there is."""
    codes: dict[int, dict[int, str]] = {}
    frame, size_at, position = b"", 0, 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xFF:
            position += 1
            continue
        segment = data[position + 4 : position + 2 + length]
        if marker in _BASELINE and not frame:
            frame, size_at = segment, position + 5
        elif marker == _RESTARTS and any(segment):
            return None
        elif marker == _TABLES:
            codes |= _codes(segment)
        elif marker == _SCAN:
            parts = _parts(frame, segment, codes)
            height, width = int.from_bytes(frame[1:3], "big"), int.from_bytes(frame[3:5], "big")
            return _Scan(position + 2 + length, size_at, height, width, parts) if parts else None
        position += 2 + length
    return None


def _parts(frame: bytes, scan: bytes, codes: dict[int, dict[int, str]]) -> list[_Part]:
    """`_Scan.parts`; none where the scan has not all colours of the frame, or codes are missing."""
    if len(frame) < 6 or len(frame) != 6 + 3 * frame[5] or len(scan) != 4 + 2 * frame[5] or scan[0] != frame[5]:
        return []
    parts = []
    for i in range(frame[5]):
        factors, tables = frame[7 + 3 * i], scan[2 + 2 * i]
        dc, ac = codes.get(tables >> 4), codes.get(0x10 | tables & 15)
        across, down = factors >> 4, factors & 15
        if dc is None or ac is None or scan[1 + 2 * i] != frame[6 + 3 * i] or not across * down:
            return []
        parts.append((across, down, dc, ac))
    return parts


def _codes(segment: bytes) -> dict[int, dict[int, str]]:
    """Huffman codes by symbol, of each table of a segment by its class and number."""
    found: dict[int, dict[int, str]] = {}
    at = 0
    while at + 17 <= len(segment):
        code, index, codes = 0, at + 17, {}
        for length, count in enumerate(segment[at + 1 : at + 17], start=1):
            for symbol in segment[index : index + count]:
                codes[symbol] = f"{code:0{length}b}"
                code += 1
            code, index = code << 1, index + count
        found[segment[at]] = codes
        at = index
    return found
