"""Damaged copies of files, by a seed: for bytes of any kind, for text, and for the headers of arrays."""

import io
import re
import struct
import zipfile

NUMBERS = ["-1", "0", "1e308", "-1e308", "nan", "inf", "99999999999999999999", "9" * 5000, "1e-320", "2147483648", ""]
INTEGERS = [0, 1, -1, 127, 255, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 1 << 33]
WORDS = ["[" * 3000, "{a=" * 2000, "'", '"""', "\0", "\ufeff", "é", "#", "=", "\\", "x" * 200_000]
NUMBER = re.compile(r"[-+]?\d+(\.\d+)?([eE][-+]?\d+)?")
MOST_BYTES = 1 << 20


def damaged_bytes(good, rng):
    """Return `good` with one to four of: bits changed, cut, repeated, put in, a number made extreme."""
    data = bytearray(good)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(min(len(data), 256) + 1) if rng.random() < 0.5 else rng.randrange(len(data) + 1)
        span = rng.choice([1, 4, 64, 1000])
        match rng.randrange(7):
            case 0 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                del data[at:]
            case 2:
                del data[at : at + span]
            case 3:
                data[at:at] = data[at : at + span] * rng.choice([1, 2, 50])
            case 4:
                data[at:at] = rng.randbytes(span)
            case _:
                size, order = rng.choice("BHIQ"), rng.choice("<>")
                width = struct.calcsize(size)
                data[at : at + width] = struct.pack(order + size, rng.choice(INTEGERS) % (1 << 8 * width))
    return bytes(data[:MOST_BYTES])


def damaged_text(good, rng):
    """Return `good` with numbers, words and lines changed, now and then with bytes changed."""
    if rng.random() < 0.25:
        return damaged_bytes(good, rng)
    lines = good.decode("utf-8", "replace").splitlines()
    for _ in range(rng.randint(1, 4)):
        k = rng.randrange(len(lines))
        match rng.randrange(6):
            case 0:
                del lines[k]
            case 1:
                lines[k:k] = [lines[k]] * rng.choice([1, 3, 200])
            case 2:
                j = rng.randrange(len(lines))
                lines[j], lines[k] = lines[k], lines[j]
            case 3:
                words = lines[k].split(" ")
                words[rng.randrange(len(words))] = rng.choice([*WORDS, *NUMBERS])
                lines[k] = " ".join(words)
            case _:
                numbers = list(NUMBER.finditer(lines[k]))
                if numbers:
                    hit = rng.choice(numbers)
                    lines[k] = lines[k][: hit.start()] + rng.choice(NUMBERS) + lines[k][hit.end() :]
        lines = lines or [""]
    return "\n".join(lines).encode("utf-8", "replace")[:MOST_BYTES]


def damaged_array(good, rng):
    """Return an `.npy` file with another header, which has the length that the file says, or with bytes changed."""
    if rng.random() < 0.4 or len(good) < 10:
        return damaged_bytes(good, rng)
    length = int.from_bytes(good[8:10], "little")
    header, content = good[10 : 10 + length].decode("latin-1"), good[10 + length :]
    for old, new in rng.sample(ARRAY_EDITS, k=rng.randint(1, 2)):
        header = header.replace(old, new, 1) if isinstance(old, str) else old.sub(new, header, count=1)
    head = header.encode("latin-1")[:65535]
    return good[:8] + len(head).to_bytes(2, "little") + head + content[: rng.randint(0, len(content) + 1)]


ARRAY_EDITS = [
    (re.compile(r"\(\d+"), "(99999999999"),
    (re.compile(r"\(\d+"), "(-3"),
    (re.compile(r"\(\d+"), "(0"),
    (re.compile(r"\(\d+"), "(1e3"),
    (re.compile(r"\(\d+"), "(" + "1," * 40),
    (re.compile(r"\(\d+"), "(" + "9" * 5000),
    (re.compile(r"'[<|>][a-z]\d+'"), "'|O'"),
    (re.compile(r"'[<|>][a-z]\d+'"), "'<f8'"),
    (re.compile(r"'[<|>][a-z]\d+'"), "'<U9'"),
    (re.compile(r"'[<|>][a-z]\d+'"), "'<M8[us]'"),
    (re.compile(r"'[<|>][a-z]\d+'"), "'|V0'"),
    (re.compile(r"'[<|>][a-z]\d+'"), "('<f4', (1000000, 100000))"),
    ("False", "True"),
    ("False", "__import__('os')"),
    ("{", "{" * 500),
    ("{", "(" * 3000),
    ("'", '"'),
    ("}", "\n\\"),
    ("shape", "shap\\N{x}e"),
]


def damaged_archive(good, rng):
    """Return an `.npz` with a damaged member in a sound archive, or with bytes changed."""
    if rng.random() < 0.4:
        return damaged_bytes(good, rng)
    out = io.BytesIO()
    method = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
    with zipfile.ZipFile(io.BytesIO(good)) as source, zipfile.ZipFile(out, "w", method) as target:
        for name in source.namelist():
            if rng.random() < 0.9:
                content = source.read(name)
                target.writestr(name, damaged_array(content, rng) if rng.random() < 0.5 else content)
    data = out.getvalue()
    return damaged_bytes(data, rng) if rng.random() < 0.1 else data
