"""Changes to HDF5 files: to their bytes, in metadata and in samples apart, and to their objects."""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import h5py
import numpy as np

from studies.mutation.values import any_attribute, any_number

LARGEST_SHAPE = 10**12
LARGEST_READ = 10**7
NAMES = ("zz", "loads", "attitude", "point", "temperature", "load_points", "content", "rotor2/pulse_times")


def mutate_hdf5(data: bytes, rng: random.Random) -> bytes:
    """The file with its bytes changed (half of the cases), or one to three of its objects."""
    if rng.random() < 0.5:
        return _change_bytes(bytearray(data), rng)
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file, np.errstate(all="ignore"):
        for _ in range(rng.randint(1, 3)):
            with suppress(Exception):  # this object does not take this change
                rng.choice(OBJECT_CHANGES)(file, rng)
    return buffer.getvalue()


# ---- bytes -----------------------------------------------------------------------------------------------------------


def _change_bytes(data: bytearray, rng: random.Random) -> bytes:
    raw = _raw_ranges(bytes(data))
    kind = rng.choice(("metadata", "metadata", "metadata", "raw", "head", "swap", "cut", "run", "tail"))
    if kind in ("metadata", "raw"):
        inside = [range(*part) for part in raw]
        for _ in range(rng.randint(1, 12)):
            position = _position(len(data), inside, rng, kind == "raw")
            data[position] = rng.choice((data[position] ^ 1 << rng.randrange(8), 0, 255, rng.randrange(256)))
    elif kind == "head":
        for _ in range(rng.randint(1, 6)):
            data[rng.randrange(min(len(data), 1000))] = rng.randrange(256)
    elif kind == "swap":
        a, b, length = rng.randrange(len(data)), rng.randrange(len(data)), rng.randint(4, 64)
        data[a : a + length], data[b : b + length] = data[b : b + length], data[a : a + length]
    elif kind == "cut":
        start = rng.randrange(len(data))
        del data[start : start + rng.choice((1, 8, 100, 5000, len(data)))]
    elif kind == "run":
        start, length = rng.randrange(len(data)), rng.randint(1, 300)
        data[start : start + length] = rng.choice((bytes(length), b"\xff" * length, rng.randbytes(length)))
    else:
        data += rng.randbytes(rng.randint(1, 2000))
    return bytes(data)


def _raw_ranges(data: bytes) -> list[tuple[int, int]]:
    """Where the samples are; all other bytes describe them."""
    ranges: list[tuple[int, int]] = []

    def visit(_name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.shape is None:
            return
        if item.chunks is None:
            start = item.id.get_offset()
            if start is not None:
                ranges.append((start, start + item.id.get_storage_size()))
            return
        for index in range(item.id.get_num_chunks()):
            chunk = item.id.get_chunk_info(index)
            ranges.append((chunk.byte_offset, chunk.byte_offset + chunk.size))

    with h5py.File(io.BytesIO(data), "r") as file:
        file.visititems(visit)
    return [(start, stop) for start, stop in ranges if start < stop]


def _position(size: int, raw: list[range], rng: random.Random, inside: bool) -> int:
    for _ in range(1000):
        position = rng.randrange(size) if not (inside and raw) else rng.choice(rng.choice(raw))
        if any(position in part for part in raw) == inside or not raw:
            return min(position, size - 1)
    return rng.randrange(size)


# ---- objects ---------------------------------------------------------------------------------------------------------


def _items(file: Any, kind: type = object) -> list[Any]:
    found: list[Any] = [file]
    file.visititems(lambda _name, item: found.append(item))
    return [item for item in found if isinstance(item, kind)]


def _any_dataset(file: Any, rng: random.Random) -> Any:
    return rng.choice(_items(file, h5py.Dataset))


def _change_attribute(file: Any, rng: random.Random) -> None:
    item = rng.choice([item for item in _items(file) if len(item.attrs)])
    name = rng.choice(sorted(item.attrs))
    kind = rng.choice(("value", "value", "value", "remove", "rename", "scale", "longer"))
    value = item.attrs[name]
    if kind == "remove":
        del item.attrs[name]
    elif kind == "rename":
        item.attrs[name + "x"] = value
        del item.attrs[name]
    elif kind == "scale":
        item.attrs[name] = np.asarray(value, float) * rng.choice((-1, 0, 1e-6, 2, 1e3, 1e9))
    elif kind == "longer":
        item.attrs.create(name, [*np.atleast_1d(value), *np.atleast_1d(value)])
    else:
        item.attrs[name] = any_attribute(rng)


def _replace(file: Any, dataset: Any, make: Callable[[Any], Any], **options: Any) -> None:
    if dataset.size > LARGEST_READ:
        raise ValueError("declared by an earlier change")
    name, attributes, data = dataset.name, dict(dataset.attrs), dataset[()]
    new = make(data)
    del file[name]
    written = file.create_dataset(name, data=new, **options)
    for key, value in attributes.items():
        text = isinstance(value, np.ndarray) and value.dtype == object
        written.attrs.create(key, value, dtype=h5py.string_dtype() if text else None)


def _reshape(file: Any, rng: random.Random) -> None:
    shapes: tuple[Callable[[Any], Any], ...] = (
        lambda a: a.T,
        lambda a: a.ravel(),
        lambda a: a[None],
        lambda a: a[..., None],
        lambda a: a[:0],
        lambda a: a[:1],
        lambda a: a[:2],
        lambda a: a[: len(a) // 2],
        lambda a: a[:-1],
        lambda a: np.concatenate([a, a]),
        lambda a: a[:, :-1],
        lambda a: a[:, :0],
        lambda a: a.ravel()[0],
        lambda a: h5py.Empty("f8"),
    )
    _replace(file, _any_dataset(file, rng), rng.choice(shapes))


def _retype(file: Any, rng: random.Random) -> None:
    kind = rng.choice(("i1", "u8", "f2", "f4", ">f8", "c16", "S4", "?", "i8"))
    _replace(file, _any_dataset(file, rng), lambda a: a.astype(kind))


def _change_values(file: Any, rng: random.Random) -> None:
    def spot(values: Any) -> Any:
        changed = np.array(values)
        changed.flat[rng.randrange(changed.size)] = any_number(rng)
        return changed

    changes: tuple[Callable[[Any], Any], ...] = (
        spot,
        spot,
        lambda a: a * 0,
        lambda a: a * np.nan,
        lambda a: a * rng.choice((-1, 1e-300, 1e-9, 1e3, 1e9, 1e300)),
        lambda a: a + 1e9,
        lambda a: a[::-1],
        lambda a: np.full_like(a, any_number(rng)),
        lambda a: np.where(np.random.default_rng(rng.randrange(99)).random(a.shape) < 0.1, np.nan, a),
        lambda a: np.round(a, 1),
        lambda a: np.repeat(a[:1], len(a), 0),
    )
    _replace(file, _any_dataset(file, rng), rng.choice(changes))


def _remove(file: Any, rng: random.Random) -> None:
    del file[rng.choice([item for item in _items(file) if item.name != "/"]).name]


def _rename(file: Any, rng: random.Random) -> None:
    item = rng.choice([item for item in _items(file) if item.name != "/"])
    file.move(item.name, rng.choice((item.name + "x", *NAMES)))


def _link(file: Any, rng: random.Random) -> None:
    name = rng.choice([item for item in _items(file) if item.name != "/"]).name
    kind = rng.choice(("self", "nothing", "external", "hard", "group"))
    soft, external = h5py.SoftLink, h5py.ExternalLink
    links = {"self": soft(name), "nothing": soft("/none"), "external": external("x.h5", name)}
    target = links.get(kind) or (file["/"] if kind == "hard" else None)
    if kind == "hard":
        name += "x"
    else:
        del file[name]
    if target is None:
        file.create_group(name)
    else:
        file[name] = target


def _declare(file: Any, rng: random.Random) -> None:
    """Declare more than is stored, or store it in a way that was never written."""
    dataset = _any_dataset(file, rng)
    name, attributes, shape = dataset.name, dict(dataset.attrs), dataset.shape
    rows = rng.choice((shape[0], shape[0], 10**9, LARGEST_SHAPE))
    chunks = rng.choice((None, (min(rows, 10**5), *shape[1:])))
    del file[name]
    declared = file.create_dataset(name, (rows, *shape[1:]), "f8", chunks=chunks)
    for key, value in attributes.items():
        text = isinstance(value, np.ndarray) and value.dtype == object
        declared.attrs.create(key, value, dtype=h5py.string_dtype() if text else None)


def _add(file: Any, rng: random.Random) -> None:
    shape = rng.choice(((), (0,), (3,), (4, 2), (2, 2, 2)))
    values: tuple[Any, ...] = (np.zeros(shape), np.full(shape, np.nan), np.zeros(shape, [("a", "f4")]), "text", b"\xff")
    file[rng.choice(NAMES)] = rng.choice(values)


def _store_otherwise(file: Any, rng: random.Random) -> None:
    options = rng.choice(({"compression": "lzf"}, {"scaleoffset": 3}, {"chunks": True, "fletcher32": True}, {}))
    _replace(file, _any_dataset(file, rng), lambda a: a, **options)


OBJECT_CHANGES: tuple[Callable[[Any, random.Random], None], ...] = (
    *(_change_attribute, _change_attribute, _change_attribute, _reshape, _reshape, _retype, _change_values),
    *(_change_values, _change_values, _remove, _rename, _link, _declare, _add, _store_otherwise),
)
