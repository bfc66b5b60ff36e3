"""Reads members of scenario files without `zipfile` and NumPy, which take longer for small ones."""

import functools
import io
import math
import struct
import zipfile
import zlib
from typing import BinaryIO

import numpy as np

METADATA = "metadata.json"
"""Member that says in words what a scenario file holds."""
DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)
"""What damaged archives raise."""
_LOCAL_HEADER = struct.Struct("<26xHH")


def members_of(file: BinaryIO) -> dict[str, zipfile.ZipInfo]:
    """Returns the table of contents of a scenario file."""
    with zipfile.ZipFile(file) as archive:
        return {member.filename: member for member in archive.infolist()}


def unpack(file: BinaryIO, member: zipfile.ZipInfo, limit: int | None = None) -> bytes:
    """Returns a member's content, or its first bytes; `zipfile` takes longer for small ones."""
    file.seek(member.header_offset)
    name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
    file.seek(name + extra, io.SEEK_CUR)
    size = member.compress_size if limit is None else min(member.compress_size, 4 * limit)
    content = file.read(size)
    if member.compress_type == zipfile.ZIP_DEFLATED:
        content = zlib.decompressobj(-zlib.MAX_WBITS).decompress(content, limit or 0)
    return content


def array_header(content: bytes) -> tuple[tuple[int, ...], np.dtype, int]:
    """Reads the header of a stored array.

    Args:
      content: its first bytes.

    Returns:
      Shape, type, and where the values begin.

    Raises:
      ValueError: that is no array, or one in Fortran order.
    """
    # magic string, version, length of the text that follows
    size = 10 + int.from_bytes(content[8:10], "little")
    return _parse_header(content[:size])


def stored_array(file: BinaryIO, member: zipfile.ZipInfo) -> np.ndarray:
    """Returns a member that holds an array, read-only.

    Raises:
      BadZipFile: the check sum does not agree.
      ValueError: that is no plain array, or bytes are missing or
        left over.
    """
    content = unpack(file, member)
    if zlib.crc32(content) != member.CRC:
        raise zipfile.BadZipFile(f"wrong check sum of {member.filename}")
    shape, kind, begin = array_header(content)
    if kind.hasobject:
        raise ValueError("array of objects")
    spare = len(content) - begin - math.prod(shape) * kind.itemsize
    if spare:
        raise ValueError(f"{abs(spare)} bytes {'after the array' if spare > 0 else 'missing'}")
    return np.frombuffer(content, kind, offset=begin).reshape(shape)


@functools.lru_cache(maxsize=4096)
def _parse_header(header: bytes) -> tuple[tuple[int, ...], np.dtype, int]:
    file = io.BytesIO(header)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("array header of another version")
    shape, fortran, kind = np.lib.format.read_array_header_1_0(file)
    if fortran:
        raise ValueError("array in Fortran order")
    return shape, kind, file.tell()
