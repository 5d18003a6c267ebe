"""Text as editors, spreadsheets and PowerShell save it; tables with any separator; what isn't read
is said in the words of that file.
"""

from __future__ import annotations

import codecs
import json
import os
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.calibrate.world import POINT_COLUMNS, read_points
from bench.config import ConfigError
from bench.rig.loading import load_board
from detector.calibration import CalibrationError, load_calibration
from instruments.bath.profile import load_profile
from tests.conftest import ROOT
from tests.examples import examples
from tests.mutants import mutants
from textfiles.documents import DocumentError, read_json, read_toml
from textfiles.tables import TableError, number, read_table
from textfiles.text import TextError, decoded, did_you_mean, in_command

CASES = ROOT / "tests" / "data" / "cases"
SAVED_AS = {
    "Notepad": lambda text: codecs.BOM_UTF8 + text.encode(),
    "PowerShell 5": lambda text: (
        codecs.BOM_UTF16_LE + text.replace("\n", "\r\n").encode("utf-16-le")
    ),
    "Unicode, big-endian": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
    "UTF-32": lambda text: text.encode("utf-32"),
    "an old Macintosh": lambda text: text.replace("\n", "\r").encode(),
    "DOS": lambda text: text.replace("\n", "\r\n").encode(),
}


@pytest.mark.parametrize("program", SAVED_AS)
def test_text_is_read_as_each_program_saves_it(program: str, tmp_path: Path) -> None:
    text = (CASES / "bom.toml").read_text(encoding="utf-8-sig")
    path = tmp_path / "board.toml"
    path.write_bytes(SAVED_AS[program](text))
    assert load_board(path).pitch_mm == 40.0
    for shipped, load in (
        (ROOT / "bench/rigs/calibration.toml", load_calibration),
        (ROOT / "instruments/bath/profiles/huber-pb.toml", load_profile),
    ):
        there = tmp_path / shipped.name
        there.write_bytes(SAVED_AS[program](shipped.read_text(encoding="utf-8")))
        load(there)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"gr\xfc\xdfe", "is not UTF-8 text: byte 2 is 0xfc. Save it as UTF-8"),
        (codecs.BOM_UTF16_LE + b"a\0\x00\xd8", "is not UTF-16"),
        (b"ab\0c", "holds zero bytes"),
    ],
)
def test_what_is_no_text_is_named(data: bytes, why: str) -> None:
    with pytest.raises(TextError, match=why):
        decoded(data)


def rewritten(separator: str, comma: str = ".", end: str = "\n", quote: str = "") -> str:
    lines = (CASES / "good.csv").read_text(encoding="utf-8").strip().split("\n")
    cells = [[f"{quote}{c.replace('.', comma)}{quote}" for c in line.split(",")] for line in lines]
    return end.join(separator.join(row) for row in cells) + end


@pytest.mark.parametrize(
    "text",
    [
        rewritten(";"),
        rewritten(";", ",") + ";" * 6 + "\n",
        rewritten("\t", ",", "\r\n"),
        rewritten(",", quote='"'),
        rewritten(",", ",", quote='"'),
        "sep=;\n" + rewritten(";", ","),
        rewritten(", ", end="\n\n") + ",,,,,,\n\n",
    ],
)
def test_touched_points_are_read_whatever_is_between_cells(text: str, tmp_path: Path) -> None:
    wanted = read_points(CASES / "good.csv")
    (tmp_path / "points.csv").write_text(text, encoding="utf-16", newline="")
    found = read_points(tmp_path / "points.csv")
    assert found.left_px.tolist() == wanted.left_px.tolist()
    assert found.touched_mm.tolist() == wanted.touched_mm.tolist()
    assert read_points(CASES / "semi.csv").right_px.tolist() == wanted.right_px.tolist()


HEADS = ",".join(POINT_COLUMNS)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (f"{HEADS}\n1,5,2,3,4,5,6,7\n", r":2: has another number .*: 8 between commas, not 7\. Is a decimal"),
        (f"{HEADS.replace(',', ';')}\n1;2;3;4;5;6\n", ":2: has another number .*: 6 between semicolons"),
        (f"{HEADS}\n1,2,3,4,5,6,7\n1,2,3,4,5,6,six\n", ":3: z_mm must be a number, is 'six'"),
        (f"{HEADS}\n1,2,3,4,5,6,1_000\n", ":2: z_mm must be a number, is '1_000'"),
        (f"{HEADS}\n1,2,3,4,5,6,1e999\n", ":2: z_mm must be finite"),
        (f"{HEADS}\n1,2,3,4,5,6,\n", ":2: z_mm must be a number, is ''"),
        (f"{HEADS},z_mm\n1,2,3,4,5,6,7,8\n", ":1: the column 'z_mm' is there twice"),
        (f"{HEADS},\n1,2,3,4,5,6,7,8\n", ":2: '8' stands in a column without a name"),
        (f"{HEADS.replace(',', ';')}\n1,5;2;3;4;5;6;7\n1.500;2;3;4;5;6;7\n", ":3: '1.500' and '1,5' in one table"),
        ("a;b\n1;2\n", r":1: the column\(s\) left_x.* are missing; the first line must name .*'a;b'"),
        ("", ":1: the column.*the file is empty"),
        (f'{HEADS}\n1,2,3,4,5,6,"7\n', ":2: is not a table of values between commas"),
    ],
)  # fmt: skip
def test_a_row_that_does_not_fit_is_never_taken(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"points\.csv" + why):
        read_points(tmp_path / "points.csv")


@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(".,"))
def test_a_number_comes_back_as_it_was_written(value: float, comma: str) -> None:
    assert number(f' "{value!r}" '.replace(".", comma)) == value


@given(st.text())
def test_a_table_is_read_or_named(text: str) -> None:
    with suppress(TableError):
        found = read_table(text)
        assert all(set(row.cells) <= set(found.heads) for row in found.rows)


DEEP = "[" * 100_000


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a = " + "1" * 4301, "an integer has thousands of digits"),
        ("a = 0x" + "f" * 4000, "an integer has thousands of bits"),
        (f"a = {DEEP}", "tables in tables without end"),
        (".".join("a" * 500) + " = 1", "more than 60 tables in each other"),
        ('a = "\\ud800"', "not TOML"),
        ("a = 1\na = 2", "not TOML: Cannot overwrite a value"),
        ("a = 2026-13-45", "not TOML"),
    ],
)
def test_no_toml_leaves_the_door_as_anything_else(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match=why):
        read_toml(text)
    (tmp_path / "b.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"b\.toml"):
        load_board(tmp_path / "b.toml")


@pytest.mark.parametrize(
    "text", [DEEP, '{"a": NaN}', '"\\ud800"', "1" * 4301, "{", "", '{"a": 1e}', "-Infinity"]
)
def test_no_json_leaves_the_door_as_anything_else(text: str) -> None:
    with pytest.raises(DocumentError):
        read_json(text)


TEXT = st.text(st.characters(exclude_categories=["Cs"]))


@pytest.mark.slow
@given(st.recursive(st.none() | st.integers() | TEXT, lambda part: st.lists(part)))
def test_what_comes_through_is_what_was_written(value: object) -> None:
    assert read_json(json.dumps(value)) == value


def of_mutants(name: str, count: int, folder: Path) -> set[str]:
    """Reads mutants of a file; what was said of those that aren't read, without their places."""
    path, said = folder / f"mutant-{name}", set()
    loads: dict[str, Callable[[Path], object]] = {"bom.toml": load_board}
    load = {**loads, "metres.toml": load_calibration}.get(name, read_points)
    for data in mutants((CASES / name).read_bytes(), count):
        path.write_bytes(data)
        try:
            load(path)
        except (ConfigError, CalibrationError) as error:
            said.add(str(error))
    return said


FILES = ("bom.toml", "metres.toml", "good.csv", "semi.csv")


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_mutants_of_files_are_read_or_named(name: str, tmp_path: Path) -> None:
    said = of_mutants(name, examples(25), tmp_path)
    assert said
    assert all(f"mutant-{name}" in each for each in said)


@pytest.mark.parametrize(
    ("path", "word"),
    [
        ("runs/20260101-x", "runs/20260101-x"),
        ("my runs/x", '"my runs/x"'),
        ("Läufe/x", "Läufe/x"),
        ("a & b", '"a & b"'),
        ("it's", '"it\'s"'),
        ("(1)", '"(1)"'),
    ],
)
def test_a_path_is_one_word_of_a_command(path: str, word: str) -> None:
    assert in_command(path) == word


@pytest.mark.skipif(os.name == "nt", reason="of a POSIX shell")
@pytest.mark.parametrize("path", ["a b", "a$HOME", 'a"b', "a`b`", "a\\b", "!a", "it's $5", "", "*"])
def test_a_shell_reads_the_word_as_the_path(path: str) -> None:
    printed = subprocess.run(["sh", "-c", f"printf %s {in_command(path)}"], capture_output=True)
    assert printed.stdout.decode() == path


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        ("nosuch", ("touch", "recall"), ""),
        ("runn", ("runs", "run", "resume"), "run"),
        ("rusume", ("runs", "run", "resume"), "resume"),
        ("path", ("bath", "arm"), "bath"),
        ("fusde", ("thesis", "fused"), "fused"),
        ("sec", ("second", "metre"), "second"),
        ("paint", ("teat-paint", "light"), "teat-paint"),
        ("zzz", (), ""),
    ],
)
def test_what_is_offered_for_a_slip_is_near_it(
    word: str, known: tuple[str, ...], meant: str
) -> None:
    assert did_you_mean(word, known) == (f'; did you mean "{meant}"?' if meant else "")
