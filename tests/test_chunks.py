"""Big arrays are written in pieces, each piece once."""

import numpy as np
import pytest

from sb3_cchain.checkpoint import chunks
from sb3_cchain.checkpoint.chunks import ChunkStore


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 1000)


@pytest.fixture
def store(tmp_path):
    return ChunkStore(tmp_path / "chunks")


def files(store):
    """All that is in the folder, with the times of their writing."""
    return {path: path.stat().st_mtime_ns for path in store.folder.rglob("*") if path.is_file()}


def data(n=4500):
    return np.random.default_rng(0).integers(0, 256, n, dtype=np.uint8)


@pytest.mark.parametrize("n_bytes", [0, 1, 999, 1000, 1001, 4500])
def test_what_was_written_is_read(store, n_bytes):
    names = store.write(memoryview(data(n_bytes)))
    assert len(names) == -(-n_bytes // 1000)
    assert store.read(names) == data(n_bytes).tobytes()


def test_arrays_of_any_type(store):
    array = np.random.default_rng(0).normal(size=(30, 20))
    assert np.frombuffer(store.read(store.write(memoryview(array)))).tolist() == array.ravel().tolist()


def test_only_pieces_that_are_new_are_written(store):
    array = data()
    first = store.write(memoryview(array))
    before = files(store)
    array[2500] ^= 1
    second = store.write(memoryview(array))
    after = files(store)
    assert [old == new for old, new in zip(first, second, strict=True)] == [True, True, False, True, True]
    assert len(before) == 5 and len(after) == 6 and all(after[path] == time for path, time in before.items())
    # The former content is there still
    assert store.read(first) == data().tobytes() and store.read(second) == array.tobytes()


def test_equal_pieces_are_one(store):
    names = store.write(memoryview(np.zeros(5000, dtype=np.uint8)))
    assert len(names) == 5 and len(files(store)) == 1
    assert store.read(names) == bytes(5000)


def test_pieces_are_compressed(store):
    store.write(memoryview(np.zeros(1000, dtype=np.uint8)))
    assert sum(path.stat().st_size for path in files(store)) < 100


def test_pieces_that_nobody_needs_are_removed(store):
    store.write(memoryview(data()))
    second = store.write(memoryview(data()[::-1].copy()))
    store.remove_all_but({*second})
    assert {path.stem for path in files(store)} == {*second}
    assert len(files(store)) == 5
    assert store.read(second) == data()[::-1].tobytes()


@pytest.mark.parametrize("damage", ["missing", "torn", "flipped", "another"])
def test_damage_is_named(store, damage):
    names = store.write(memoryview(data()))
    path = next(path for path in files(store) if path.stem == names[2])
    content = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    elif damage == "torn":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    else:
        path.write_bytes(next(other for other in files(store) if other.stem == names[1]).read_bytes())
    for read in (store.read, store.check):
        with pytest.raises(ValueError, match=f"{path.name}.*(missing|damaged)"):
            read(names)


def test_a_piece_that_was_not_finished_is_no_piece(store, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr("os.replace", no_space)
        store.write(memoryview(data()))
    assert files(store) == {}
    assert store.read(store.write(memoryview(data()))) == data().tobytes()


def no_space(*_):
    raise OSError("No space left on device")
