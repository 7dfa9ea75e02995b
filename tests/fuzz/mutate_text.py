"""Mutations of bytes, and of CSV tables."""

from __future__ import annotations

from random import Random

LONG = 200_000  # characters of a cell, beyond the csv module's limit of 131,072
CONSTANTS = (b"", b"\x00", b"\n", b"\xff\xfe", b"\x00" * 512, b"PK\x03\x04", b"PK\x05\x06" + b"\x00" * 18, b"{}", b"[]")


def mutate_bytes(random: Random, content: bytes) -> bytes:
    """One to three changes that know nothing of the format."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        content = random.choice(_BYTES)(random, content)
    return content


def _flipped(random: Random, content: bytes) -> bytes:
    out = bytearray(content)
    for _ in range(random.randint(1, 8) if out else 0):
        out[random.randrange(len(out))] ^= 1 << random.randrange(8)
    return bytes(out)


def _overwritten(random: Random, content: bytes) -> bytes:
    at, size = random.randint(0, len(content)), random.choice((1, 2, 4, 8, 64))
    return content[:at] + random.randbytes(size) + content[at + size :]


def _truncated(random: Random, content: bytes) -> bytes:
    return content[: random.randint(0, len(content))]


def _beheaded(random: Random, content: bytes) -> bytes:
    return content[random.randint(0, len(content)) :]


def _inserted(random: Random, content: bytes) -> bytes:
    at = random.randint(0, len(content))
    return content[:at] + random.randbytes(random.choice((1, 3, 16, 300))) + content[at:]


def _cut_out(random: Random, content: bytes) -> bytes:
    first, last = sorted(random.randint(0, len(content)) for _ in range(2))
    return content[:first] + content[last:]


def _repeated(random: Random, content: bytes) -> bytes:
    first, last = sorted(random.randint(0, len(content)) for _ in range(2))
    return content[:last] + content[first:last] + content[last:]


def _zeroed(random: Random, content: bytes) -> bytes:
    first, last = sorted(random.randint(0, len(content)) for _ in range(2))
    return content[:first] + bytes(last - first) + content[last:]


def _replaced(random: Random, content: bytes) -> bytes:
    return random.choice(CONSTANTS) if random.random() < 0.2 else _overwritten(random, content)


_BYTES = (_flipped, _overwritten, _truncated, _beheaded, _inserted, _cut_out, _repeated, _zeroed, _replaced)


# ---------------------------------------------------------------- CSV

_CELLS = (
    *("", " ", "nan", "NaN", "inf", "-inf", "1e999", "abc", "0x10", "1_000", "1,5", "1;5", '"', '""', "١", "true"),
    *("-0", "1e-400", "9" * 400, "=1+1", "\x00", "\ud800", "é", "w" * LONG, "time", "\t", "1 2", "+5", "1e5"),
)


def mutate_csv(random: Random, content: bytes) -> bytes:
    """One to three changes of cells, rows, the header, or the encoding."""
    rows = [line.split(",") for line in content.decode().splitlines()]
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        random.choice(_CSV)(random, rows)
    end, between = random.choices(("\n", "\r\n", "\r"), (8, 1, 1))[0], random.choices((",", ";", "\t"), (18, 1, 1))[0]
    text = end.join(between.join(row) for row in rows)
    encoding = random.choices(("utf-8", "utf-8-sig", "utf-16", "latin-1", "utf-32"), (20, 1, 1, 1, 1))[0]
    return (text + "\n").encode(encoding, errors="surrogatepass" if encoding.startswith("utf") else "replace")


def _row(random: Random, rows: list[list[str]]) -> int:
    return 0 if random.random() < 0.2 else random.randrange(len(rows))


def _cell(random: Random, rows: list[list[str]]) -> None:
    if rows and rows[i := _row(random, rows)]:
        rows[i][random.randrange(len(rows[i]))] = random.choice(_CELLS)


def _extra_cell(random: Random, rows: list[list[str]]) -> None:
    if rows:
        rows[i := _row(random, rows)].insert(random.randint(0, len(rows[i])), random.choice(_CELLS))


def _less(random: Random, rows: list[list[str]]) -> None:
    if rows and rows[i := _row(random, rows)]:
        del rows[i][random.randrange(len(rows[i]))]


def _no_row(random: Random, rows: list[list[str]]) -> None:
    if rows:
        del rows[_row(random, rows)]


def _row_again(random: Random, rows: list[list[str]]) -> None:
    if rows:
        rows.insert(random.randint(0, len(rows)), list(rows[_row(random, rows)]))


def _other_order(random: Random, rows: list[list[str]]) -> None:
    body = rows[1:]
    body.sort(key=lambda _: random.random()) if random.random() < 0.5 else body.reverse()
    rows[1:] = body


def _few(random: Random, rows: list[list[str]]) -> None:
    del rows[random.randint(0, min(3, len(rows))) :]


def _column(random: Random, rows: list[list[str]]) -> None:
    """A column gone, or twice."""
    if rows and rows[0]:
        c, twice = random.randrange(len(rows[0])), random.random() < 0.5
        for row in rows:
            if c < len(row):
                row.insert(c, row[c]) if twice else row.pop(c)


_CSV = (_cell, _cell, _cell, _extra_cell, _less, _no_row, _row_again, _other_order, _few, _column)
