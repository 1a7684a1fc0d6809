"""Ways in which a file can be wrong: its bytes, its JSON, its zip, its arrays."""

from __future__ import annotations

import copy
import io
import json
import random
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

WORDS = [b"\xff" * 8, bytes(8), *((2**k).to_bytes(8, "little") for k in (16, 31, 32, 40, 63)), b"\x7f" + b"\xff" * 7]
ODD = [
    None, True, False, 0, 1, -1, 2, 7, 0.5, -0.0, 1e-320, 1e308, -1e308, float("nan"), float("inf"), float("-inf"),
    2**31, 2**63, -(2**63), 10**18, 10**30, "", "x", "0", "nan", "é\u202e", "\x00", "*/", "\x1b[2J",
    "../..", "A" * 70_000,
    [], [[]], {}, [0], [None], [1e308] * 4, {"a": 1}, {"type": "Box"}, [True], "os:system",
]  # fmt: skip


BYTE_WAYS = [
    "bit", "bit", "bit", "bits", "byte", "cut", "cut", "remove", "repeat", "insert", "zero", "ones", "word",
    "word", "append", "swap", "splice", "empty",
]  # fmt: skip
VALUE_WAYS = [
    "set", "set", "set", "set", "remove", "scale", "scale", "sibling", "repeat", "rename", "wrap", "longer",
    "shorter", "text",
]  # fmt: skip
TEXT_WAYS = [
    "key", "key", "key", "number", "number", "deep", "brackets", "cut", "bom", "behind", "blanks", "latin", "nul",
    "quote",
]  # fmt: skip
ZIP_WAYS = [
    "method", "rename", "missing", "extra", "twice", "upward", "comment", "before", "lies", "encrypted", "empty",
    "level",
]  # fmt: skip
ARRAY_WAYS = [
    "dtype", "shape", "nan", "inf", "scale", "missing", "extra", "pickle", "scalar", "empty", "complex", "text",
    "big", "rename", "values",
]  # fmt: skip
LINE_WAYS = [
    "drop", "twice", "swap", "digit", "upper", "path", "blank", "crlf", "tail", "star", "shuffle", "many", "nul",
]  # fmt: skip
RECORD_WAYS = [
    "drop", "twice", "swap", "foreign", "header", "end",
]  # fmt: skip


def mutated_bytes(rng: random.Random, content: bytes, other: bytes = b"") -> tuple[str, bytes]:
    """Changes some bytes; ``other`` is a file of the same kind, of which a piece may be taken."""
    data = bytearray(content)
    size = max(1, len(data))
    at = rng.randrange(size)
    length = min(rng.choice((1, 4, 16, 64, 512)), size)
    way = rng.choice(BYTE_WAYS)
    if way == "bit":
        data[at] ^= 1 << rng.randrange(8)
    elif way == "bits":
        for _ in range(rng.randint(2, 12)):
            data[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif way == "byte":
        data[at] = rng.randrange(256)
    elif way == "cut":
        del data[at:]
    elif way == "remove":
        del data[at : at + length]
    elif way == "repeat":
        data[at:at] = data[at : at + length]
    elif way == "insert":
        data[at:at] = rng.randbytes(length)
    elif way in ("zero", "ones"):
        end = min(size, at + length)
        data[at:end] = (b"\0" if way == "zero" else b"\xff") * (end - at)
    elif way == "word":
        at &= ~(rng.choice((1, 4, 8)) - 1)
        data[at : at + 8] = rng.choice([*WORDS, size.to_bytes(8, "little"), (size + 1).to_bytes(8, "little")])
    elif way == "append":
        data += rng.choice((rng.randbytes(length), bytes(length), bytes(data[-length:])))
    elif way == "swap":
        to = rng.randrange(size)
        data[at : at + length], data[to : to + length] = data[to : to + length], data[at : at + length]
    elif way == "splice":
        data[at:] = other[at:] if other else data[: size - at]
    elif rng.random() < 0.1:
        data.clear()
    else:
        data[at] ^= 0xFF
        way = "inverted"
    return f"{way} at {at}", bytes(data)


def mutated_json(rng: random.Random, document: Any) -> tuple[str, str]:
    """Changes values of a document, or its text."""
    document = copy.deepcopy(document)
    done = [_changed(rng, document) for _ in range(rng.choice((1, 1, 1, 1, 2, 3)))] if rng.random() < 0.85 else []
    text = json.dumps(document)
    if not done or rng.random() < 0.03:
        what, text = _mutated_text(rng, text)
        done.append(what)
    return " & ".join(done), text


def _changed(rng: random.Random, document: Any) -> str:
    holder, path = document, []
    while True:  # down at random, so that what is deep and often does not crowd out what is shallow and once
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            return "nothing"
        key = rng.choice(keys)
        path.append(str(key))
        if not isinstance(holder[key], (dict, list)) or not holder[key] or rng.random() < 0.15:
            break
        holder = holder[key]
    value = holder[key]
    way = rng.choice(VALUE_WAYS)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if way == "remove":
        del holder[key]
    elif way == "scale" and number:
        factor = rng.choice((-1, 0, 10, 1000, 10**9, 1e-9, 1.5))
        holder[key] = value * factor
        way = f"times {factor}"
    elif way == "sibling":
        holder[key] = copy.deepcopy(holder[rng.choice(keys)])
    elif way == "repeat" and isinstance(value, list) and value:
        value.append(copy.deepcopy(rng.choice(value)))
    elif way == "rename" and isinstance(holder, dict):
        holder[rng.choice((key + "x", key.upper(), "", "__class__"))] = holder.pop(key)
    elif way == "wrap":
        holder[key] = rng.choice(([value], {"value": value}, str(value)))
    elif way == "longer" and isinstance(value, list) and value:
        holder[key] = value * rng.choice((2, 1000))
    elif way == "shorter" and isinstance(value, list):
        holder[key] = value[: len(value) // 2]
    elif way == "text" and isinstance(value, str) and value.startswith("{"):
        try:  # JSON within JSON, as of spaces and specs
            _, holder[key] = mutated_json(rng, json.loads(value))
        except ValueError:
            holder[key] = value[: len(value) // 2]
    else:
        odd = rng.choice(ODD)
        holder[key] = copy.deepcopy(odd)
        way = f"= {odd!r:.30}"
    return f"{'.'.join(path)} {way}"


def _mutated_text(rng: random.Random, text: str) -> tuple[str, str]:
    way = rng.choice(TEXT_WAYS)
    if way == "key":  # twice, with another value
        pairs = list(re.finditer(r'"[a-z_]+": ', text))
        pair = rng.choice(pairs)
        value = json.dumps(rng.choice(ODD))
        return f"{pair.group()} twice", f"{text[: pair.start()]}{pair.group()}{value}, {text[pair.start() :]}"
    if way == "number":
        numbers = list(re.finditer(r"-?\d+(\.\d+)?(e-?\d+)?", text))
        place = rng.choice(numbers)
        new = rng.choice(
            ("1e400", "-1e400", "9" * 4000, "9" * 5000, "NaN", "Infinity", "0x10", "1_0", "01", "1e-400", "9" * 400)
        )
        return f"number {new:.8}", text[: place.start()] + new + text[place.end() :]
    if way in ("deep", "brackets"):
        n = rng.choice((100, 1000, 100_000))
        one, other = ('{"a":', "}") if way == "deep" else ("[", "]")
        return f"{way} {n}", f'{{"deep": {one * n}1{other * n}, {text[1:]}'
    changed = {
        "cut": text[: rng.randrange(len(text))],
        "bom": "\ufeff" + text,
        "behind": text + rng.choice(("{}", "x", "\0", text)),
        "blanks": text[:1] + " " * 100_000 + text[1:],
        "latin": text[: len(text) // 2] + "\ud800" + text[len(text) // 2 :],
        "nul": text.replace('"', '"\0', 1),
        "quote": text.replace('"', "'"),
    }
    return way, changed[way]


# --- archives -----------------------------------------------------------------------------------------------------


Members = dict[str, bytes]


def members(path: Path) -> Members:
    """The members of a zip."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def document_name(found: Members) -> str:
    """The member that is JSON."""
    return next(name for name in found if name.endswith(".json"))


def arrays_name(found: Members) -> str:
    """The member that holds arrays."""
    return next(name for name in found if name.endswith(".npz"))


def write_zip(path: Path, found: Members, method: int = zipfile.ZIP_DEFLATED) -> None:
    """A zip of these members, each in order."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in found.items():
            archive.writestr(name, content)


def with_document(found: Members, document: Any) -> Members:
    """The members with another document, or its text."""
    text = document if isinstance(document, str) else json.dumps(document)
    return found | {document_name(found): text.encode("utf-8", "surrogatepass")}


def mutated_zip(rng: random.Random, path: Path, found: Members) -> str:
    """Writes a zip with right sums whose structure is wrong."""
    way = rng.choice(ZIP_WAYS)
    names = list(found)
    name = rng.choice(names)
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)) if way == "method" else 8
    if way == "rename":
        found = {(key.upper() if key == name else key): value for key, value in found.items()}
    elif way == "missing":
        found = {key: value for key, value in found.items() if key != name}
    elif way in ("extra", "upward"):
        found = found | {"../../canary" if way == "upward" else f"extra{rng.randrange(9)}": rng.randbytes(50)}
    elif way == "empty":
        found = found | {name: b""}
    write_zip(path, found, method)
    if way == "twice":
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, rng.choice((found[name], b"{}", found[name][::-1])))
    elif way == "comment":
        with zipfile.ZipFile(path, "a") as archive:
            archive.comment = rng.randbytes(rng.choice((1, 1000, 65535)))
    elif way == "before":
        path.write_bytes(rng.randbytes(rng.choice((1, 64, 5000))) + path.read_bytes())
    elif way in ("lies", "encrypted", "level"):
        data = bytearray(path.read_bytes())
        headers = [m.start() for m in re.finditer(b"PK\x01\x02|PK\x03\x04", data)]
        at = rng.choice(headers)
        central = data[at + 2] == 1
        field = {"lies": 20 + 4 * rng.randrange(2), "encrypted": 8, "level": 10}[way] if central else {
            "lies": 18 + 4 * rng.randrange(2), "encrypted": 6, "level": 8}[way]  # fmt: skip
        size = 4 if way == "lies" else 2
        data[at + field : at + field + size] = rng.choice((b"\xff" * size, b"\1" + bytes(size - 1), bytes(size)))
        path.write_bytes(bytes(data))
    return f"{way} {name}"


class Opened:
    """What runs when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (eval, (f"open({CANARY_PATH!r}, 'w')",))


CANARY_PATH = "canary"


def mutated_arrays(rng: random.Random, content: bytes) -> tuple[str, bytes]:
    """Changes arrays of an npz; their zip is right."""
    with np.load(io.BytesIO(content)) as stored:
        arrays: dict[str, Any] = {key: stored[key] for key in stored.files}
    way = rng.choice(ARRAY_WAYS)
    if not arrays:
        arrays, way = {"x": np.zeros(3)}, "extra"
    key = rng.choice(list(arrays))
    value = arrays[key]
    flat = np.array(value, np.float64).reshape(-1) if value.dtype.kind in "fiub" else np.zeros(3)
    place = rng.randrange(max(1, flat.size))
    if way == "dtype":
        arrays[key] = value.astype(rng.choice(("f2", "f4", ">f8", "i1", "i8", "?", "f8")))
    elif way == "shape":
        arrays[key] = rng.choice((flat, flat[:, None], flat[:-1], np.append(flat, 0.0), flat[None, None]))
    elif way in ("nan", "inf", "values", "scale") and flat.size:
        changes = {"nan": np.nan, "inf": np.inf, "values": rng.gauss(0, 1), "scale": flat[place] * 1e30}
        flat[place] = changes[way]
        arrays[key] = flat.reshape(value.shape).astype(value.dtype if value.dtype.kind == "f" else np.float64)
    elif way == "missing":
        del arrays[key]
    elif way == "extra":
        arrays["extra/x"] = np.zeros(4)
    elif way == "pickle":
        arrays[key] = np.array([Opened()], dtype=object)
    elif way == "scalar":
        arrays[key] = np.float64(1.0)
    elif way == "empty":
        arrays[key] = np.zeros((0, *value.shape[1:]))
    elif way == "complex":
        arrays[key] = value.astype(complex) if value.dtype.kind in "fiub" else value
    elif way == "text":
        arrays[key] = np.array(["x", "y"])
    elif way == "big":
        arrays[key] = np.zeros(2_000_000, np.float32)
    elif way == "rename":
        arrays[key + "x"] = arrays.pop(key)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return f"{key} {way}", buffer.getvalue()


# --- lines and logs -----------------------------------------------------------------------------------------------


def mutated_lines(rng: random.Random, text: str) -> tuple[str, bytes]:
    """Changes the lines of sums."""
    lines = text.splitlines()
    at = rng.randrange(len(lines))
    way = rng.choice(LINE_WAYS)
    digest, _, path = lines[at].partition("  ")
    if way == "drop":
        del lines[at]
    elif way == "twice":
        lines.append(lines[at] if rng.random() < 0.5 else f"{'0' * 64}  {path}")
    elif way == "swap":
        lines[at] = f"{lines[at - 1].partition('  ')[0]}  {path}"
    elif way == "digit":
        k = rng.randrange(64)
        lines[at] = f"{digest[:k]}{rng.choice('0123456789abcdef')}{digest[k + 1 :]}  {path}"
    elif way == "upper":
        lines[at] = lines[at].upper()
    elif way == "path":
        odd = ("../x", "/etc/passwd", f"./{path}", f"data//{path}", "data", "SHA256SUMS", "é", "", path * 2000, "a\tb")
        lines[at] = f"{digest}  {rng.choice(odd)}"
    elif way == "many":
        lines += [f"{'0' * 64}  file{k}" for k in range(rng.choice((100, 20_000)))]
    elif way == "shuffle":
        rng.shuffle(lines)
    elif way in ("blank", "star", "tail", "nul"):
        lines[at] = {"blank": "", "star": f"{digest} *{path}", "tail": lines[at] + " ", "nul": lines[at] + "\0"}[way]
    end = "\r\n" if way == "crlf" else "\n"
    return f"{way} {at}", (end.join(lines) + end * (rng.random() < 0.9)).encode()


def mutated_log(rng: random.Random, content: bytes, other: bytes, marker: bytes = b"\xb7\x1eR\n") -> tuple[str, bytes]:
    """Changes bytes, or whole records between their markers, whose sums stay right."""
    pieces = content.split(marker)
    if rng.random() < 0.6 or len(pieces) < 4:
        return mutated_bytes(rng, content, other)
    way = rng.choice(RECORD_WAYS)
    at, to = rng.randrange(1, len(pieces)), rng.randrange(1, len(pieces))
    if way == "drop":
        del pieces[at]
    elif way == "twice":
        pieces.insert(to, pieces[at])
    elif way == "swap":
        pieces[at], pieces[to] = pieces[to], pieces[at]
    elif way in ("foreign", "header"):
        theirs = other.split(marker)
        pieces[1 if way == "header" else at] = theirs[1 if way == "header" else rng.randrange(1, len(theirs))]
    else:
        pieces = pieces[:at]
    return f"record {at} {way}", marker.join(pieces)
