"""The images: MNIST, from files or by torchvision, or scikit-learn's digits."""

import gzip
import zlib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch as th

N_CLASSES = 10

# Of the training images; each may have the suffix .gz
IDX_FILES = ("train-images-idx3-ubyte", "train-labels-idx1-ubyte")

# Where torchvision keeps what it downloads
DOWNLOADS = Path("logs/mnist")


@dataclass(frozen=True)
class Images:
    """
    Images of digits.

    :param source: What they are
    :param pixels: Numbers from -1 to 1, ``(n_images, n_pixels)``
    :param labels: Digits, ``(n_images,)``
    """

    source: str
    pixels: th.Tensor
    labels: th.Tensor

    @property
    def checksum(self) -> int:
        """Tells other images from these."""
        return zlib.crc32(self.labels.numpy().tobytes(), zlib.crc32(self.pixels.numpy().tobytes()))


def load_images(data: str | None = None) -> Images:
    """
    :param data: A folder with MNIST's IDX files; ``"mnist"`` for torchvision's, downloaded when needed; or ``"digits"`` for
        those that come with scikit-learn. None is MNIST where torchvision is installed, and the digits otherwise
    :return: The images
    :raises ImportError: When the package for them is not installed
    :raises ValueError: When there are no such files in the folder, or they are damaged
    """
    if data is None:
        data = "mnist" if find_spec("torchvision") else "digits"
    if data == "mnist":
        return _mnist()
    return _digits() if data == "digits" else _from_files(Path(data))


def _mnist() -> Images:
    try:
        from torchvision.datasets import MNIST
    except ImportError as error:
        raise ImportError(
            f'MNIST needs torchvision ({error}): pip install "sb3-cchain[supervised]", or give a folder with its files, --data'
        ) from error
    mnist = MNIST(str(DOWNLOADS), train=True, download=True)
    return _images("MNIST", mnist.data.numpy(), mnist.targets.numpy(), white=255)


def _digits() -> Images:
    try:
        from sklearn.datasets import load_digits
    except ImportError as error:
        raise ImportError(
            f'There are no images: pip install "sb3-cchain[supervised]" for MNIST, or scikit-learn for its digits of 8 x 8 '
            f"pixels ({error}), or give a folder with MNIST's files, --data"
        ) from error
    pixels, labels = load_digits(return_X_y=True)
    return _images("scikit-learn's digits, not MNIST", pixels, labels, white=16)


def _from_files(folder: Path) -> Images:
    pixels, labels = (read_idx(_find(folder, name)) for name in IDX_FILES)
    if pixels.ndim != 3 or labels.shape != pixels.shape[:1] or labels.max(initial=0) >= N_CLASSES:
        raise ValueError(
            f"{folder} must hold images and a label from 0 to 9 for each, got shapes {pixels.shape} and {labels.shape}"
        )
    return _images("MNIST's files", pixels, labels, white=255)


def _find(folder: Path, name: str) -> Path:
    for path in (folder / name, folder / f"{name}.gz"):
        if path.is_file():
            return path
    raise ValueError(f'--data must be "mnist", "digits" or a folder with {name} or {name}.gz, got {str(folder)!r}')


def read_idx(path: Path) -> np.ndarray:
    """
    Read a file of unsigned bytes in the format of MNIST: two zeros, 8, the number of dimensions, the sizes, the entries.

    :param path: The file, compressed when its suffix is ``.gz``
    :return: The array
    :raises ValueError: When it is another file, or not whole
    """
    try:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if len(content) < 4 or content[:3] != b"\0\0\x08":
        raise ValueError(f"{path} must be an IDX file of bytes, which begins with 0, 0, 8, got {list(content[:3])}")
    n_dims = content[3]
    start = 4 + 4 * n_dims
    if len(content) >= start:
        shape = np.frombuffer(content, ">u4", n_dims, offset=4).astype(int)
        if len(content) == start + shape.prod():
            return np.frombuffer(content, np.uint8, offset=start).reshape(shape)
    raise ValueError(f"{path} is damaged: it does not hold as many bytes as its head says")


def _images(source: str, pixels: np.ndarray, labels: np.ndarray, white: int) -> Images:
    rows = pixels.reshape(len(pixels), -1).astype(np.float32) / white * 2 - 1
    size = "x".join(map(str, pixels.shape[1:])) if pixels.ndim == 3 else "8x8"
    return Images(f"{source} ({len(rows)} images of {size})", th.from_numpy(rows), th.from_numpy(labels.astype(np.int64)))
