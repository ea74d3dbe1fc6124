"""Big arrays in pieces that are named after their content, so that a checkpoint writes only the pieces that are new."""

import hashlib
import zlib
from collections.abc import Collection, Sequence
from pathlib import Path

from sb3_cchain.checkpoint.files import write_safely

CHUNK_BYTES = 4 * 2**20


class ChunkStore:
    """
    A folder of compressed pieces.

    :param folder: The folder; it is made when the first piece is written
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def write(self, data: memoryview) -> list[str]:
        """
        :param data: Bytes
        :return: The names of its pieces. Those that are there already are not written again
        """
        data = data.cast("B")
        names = []
        for start in range(0, len(data), CHUNK_BYTES):
            chunk = data[start : start + CHUNK_BYTES]
            name = hashlib.blake2b(chunk, digest_size=20).hexdigest()
            names.append(name)
            if not self._path(name).exists():
                with write_safely(self._path(name)) as path:
                    path.write_bytes(zlib.compress(chunk, level=1))
        return names

    def read(self, names: Sequence[str]) -> bytearray:
        """
        :param names: What :meth:`write` returned
        :return: The bytes
        :raises ValueError: When a piece is missing or damaged
        """
        data = bytearray()
        for name in names:
            data += self._read(name)
        return data

    def check(self, names: Sequence[str]) -> None:
        """
        :param names: Names of pieces
        :raises ValueError: When a piece is missing or damaged
        """
        for name in dict.fromkeys(names):  # that of zeros comes often
            self._read(name)

    def _read(self, name: str) -> bytes:
        path = self._path(name)
        try:
            chunk = zlib.decompress(path.read_bytes())
        except (OSError, zlib.error) as error:
            raise ValueError(f"{path} is missing or damaged: {error}") from error
        if hashlib.blake2b(chunk, digest_size=20).hexdigest() != name:
            raise ValueError(f"{path} is damaged: its content is not what its name says")
        return chunk

    def remove_all_but(self, names: Collection[str]) -> None:
        """
        :param names: The pieces that stay
        """
        for path in self.folder.glob("*/*"):
            if path.stem not in names:
                path.unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        return self.folder / name[:2] / f"{name}.z"
