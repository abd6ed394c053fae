"""MATLAB .mat files of versions 5 to 7 (format documented by MathWorks): arrays of numbers and strings at top level.

SciPy reads more kinds of arrays, but its compiled reader crashes the process on some damaged files.
"""

import struct
import zlib
from collections.abc import Iterator

import numpy as np

_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1", 17: "u2",
}  # fmt: skip


def read_mat(content: bytes, max_bytes: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and array of each numeric or string variable; raise ValueError for damage, or above `max_bytes`."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("no byte order in the header")
    for kind, data in _elements(content[128:], order):  # after the header
        if kind == _COMPRESSED:
            unpacked = _decompress(data, max_bytes)
            kind, data = next(_elements(unpacked, order), (0, b""))
        if kind == _MATRIX:
            yield from _read_matrix(data, order)


def _decompress(data: bytes, max_bytes: int) -> bytes:
    stream = zlib.decompressobj()
    try:
        unpacked = stream.decompress(data, max_bytes)
    except zlib.error as error:
        raise ValueError(f"a compressed part is damaged: {error}") from error
    if not stream.eof:
        raise ValueError("a compressed part is truncated or too large")
    return unpacked


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of each element; a small element stores its size in the upper half of its type."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        start = at + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if start + size > len(data):
            raise ValueError(f"an element of {size:,} bytes reaches beyond the end")
        yield kind, data[start : start + size]
        at = start + size
        if kind != _COMPRESSED:
            at = -(-at // 8) * 8  # padded


def _read_matrix(data: bytes, order: str) -> Iterator[tuple[str, np.ndarray]]:
    parts = list(_elements(data, order))
    if len(parts) < 4 or len(parts[0][1]) < 8:
        return  # an empty array, or an object
    flags = struct.unpack_from(order + "I", parts[0][1])[0]
    is_complex, kind = flags & 0x0800, flags & 0xFF
    string, numbers = 4, range(6, 16)  # kinds of arrays; numbers are double, single and integers
    name = parts[2][1].decode("ascii", errors="replace")
    values = [
        np.frombuffer(raw, order + _NUMBERS[code])
        for code, raw in parts[3 : 5 if is_complex else 4]
        if code in _NUMBERS and len(raw) % int(_NUMBERS[code][1]) == 0
    ]
    shape = np.frombuffer(parts[1][1], order + "i4").astype(int)
    if not values or np.prod(shape.astype(float)) != values[0].size:
        return  # a cell or a structure, whose parts are not numbers
    if kind == string:
        yield name, np.array("".join(map(chr, values[0])))
    elif kind in numbers:
        array = values[0] if len(values) == 1 else values[0] + 1j * values[1]
        yield name, array.reshape(shape, order="F")
