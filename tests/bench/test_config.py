"""Files that people write: every fault at once, each in its place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bench.config import ConfigError, find_places, nearest, read_config
from bench.rig.loading import RIGS, find_rig, load_rig
from bench.rig.scripted_answers import load_answers
from bench.script.model import TRIALS, Script, find_script, load_script
from tests.bench.small_cameras import write_calibration


def refused(load: Callable[..., object], *given: object) -> ConfigError:
    """Why these can't be loaded."""
    with pytest.raises(ConfigError) as caught:
        load(*given)
    return caught.value


def rig_with(tmp_path: Path, change: dict[str, str]) -> Path:
    """A copy of the emulated rig in which each key of ``change`` is replaced."""
    text = (RIGS / "emulated.toml").read_text(encoding="utf-8")
    for old, new in change.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    write_calibration(tmp_path)
    return path


def test_shipped_rigs_load_and_have_the_same_keys() -> None:
    emulated, lab = (load_rig(find_rig(name)).rig for name in ("emulated", "lab.example"))
    assert (bool(emulated.emulated), bool(lab.emulated)) == (True, False)
    assert set(emulated.urls) == set(lab.urls)


def test_the_lab_example_explains_every_key() -> None:
    text = (RIGS / "lab.example.toml").read_text(encoding="utf-8")
    lab = load_rig(find_rig("lab.example")).rig.model_dump(exclude={"emulation"})
    places = find_places(text)
    lines = text.split("\n")
    for section, value in lab.items():
        for path in [(section, key) for key in value] if isinstance(value, dict) else [(section,)]:
            place, exact = nearest(places, path)
            assert exact, f"{path} is not in lab.example.toml"
            assert "#" in lines[place.line - 1], f"{path} is not explained"


def test_all_faults_come_at_once_each_with_its_line(tmp_path: Path) -> None:
    path = rig_with(
        tmp_path,
        {
            'profile = "julabo-presto"': 'profle = "julabo-presto"',
            "seed = 1": "seed = -1",
            '[stage]\nurl = "emulator:"': '[stage]\nurl = "nonsense"\nfeed_mm_per_min = "fast"',
        },
    )
    error = refused(load_rig, path)
    text = str(error)
    lines = path.read_text(encoding="utf-8").split("\n")
    for word in ("profle", "seed = -1", "nonsense", '"fast"'):
        number = next(i for i, line in enumerate(lines, 1) if word in line)
        assert f"{path}:{number}: " in text
    assert 'did you mean "profile"' in text
    assert len(error.faults) == 4


def test_the_caret_stands_under_the_value(tmp_path: Path) -> None:
    path = rig_with(tmp_path, {"seed = 1": "seed = -17"})
    shown, caret = str(refused(load_rig, path)).split("\n")[-2:]
    assert shown[shown.index("-17") :].startswith("-17")
    assert caret.index("^") == shown.index("-17")
    assert caret.count("^") == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {'url = "emulator:"\nprofile': 'url = "serial:x"\nprofile'},
            'allowed: "emulator:", "tcp://host:port"',
        ),
        ({'profile = "julabo-presto"': 'profile = "julabo-prest"'}, 'did you mean "julabo-presto"'),
        ({'profile = "julabo-presto"': 'profile = "mine.toml"'}, "no such file"),
        (
            {'calibration = "calibration.toml"': 'calibration = "nowhere.toml"'},
            "no such file beside the rig file",
        ),
        (
            {'[operator]\nurl = "emulator:"': '[operator]\nurl = "emulater:"'},
            'did you mean "emulator:"',
        ),
        ({'profile = "julabo-presto"\n': ""}, "profile is missing: which controller it is"),
        ({"[cameras]": "[limits]\nset_point_c = [36, 20]\n[cameras]"}, "smaller one"),
        ({"[cameras]": "[cameras"}, "not TOML"),
        ({"[cameras]": "[cameras]\nsettle_s = inf"}, "cameras.settle_s"),
        (
            {"[cameras]": '[cameras]\nsettle_s = "33"'},
            "cameras.settle_s: input should be a valid number (found '33')",
        ),
        ({"[arm]": "[arm]\ncheck_touches = 1"}, "greater than or equal to 2"),
        ({"seed = 1": "seed = true"}, "seed: input should be a valid integer (found True)"),
        (
            {"[cameras]": "[limits]\nbath_plausible_c = [nan, 60]\n[cameras]"},
            "limits.bath_plausible_c[1]: input should be a finite number",
        ),
    ],
)
def test_each_wrong_value_says_what_is_allowed(
    tmp_path: Path, change: dict[str, str], message: str
) -> None:
    assert message in str(refused(load_rig, rig_with(tmp_path, change)))


def test_a_fault_in_the_calibration_is_shown_in_the_calibration(tmp_path: Path) -> None:
    path = rig_with(tmp_path, {})
    calibration = tmp_path / "calibration.toml"
    text = calibration.read_text(encoding="utf-8")
    calibration.write_text(text.replace("mirrored = true", 'mirrored = "yes"'), encoding="utf-8")
    why = str(refused(load_rig, path))
    assert "cameras.thermal.mirrored" in why
    assert why.startswith(str(calibration))


def test_shipped_scripts_load() -> None:
    loaded = load_script(find_script(None))
    script = loaded.script
    assert [trial.situation for trial in script.trials] == [
        "non_vertical",
        "overlapping",
        "spurious_teat",
        "hot_body_at_base",
        "hot_body_at_ends",
        "cooler_bodies",
    ]
    published = [trial.published.found for trial in script.trials if trial.published]
    assert published == [4, 3, 4, 4, 0, 3]
    assert len(loaded.planned) == 18


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('layout = "overlapping"', 'layout = "overlaping"', "did you mean"),
        ('{ kind = "cold_teat" }', '{ kind = "cold_teet" }', "object 1"),
        ('detectors = ["thesis"]', 'detectors = ["thesys"]', 'did you mean "thesis"'),
        ('detectors = ["thesis"]', 'detectors = ["thesis", "thesis"]', "'thesis' is there twice"),
        ('kind = "success"', 'kind = "sucess"', """.kind: 'sucess' is not allowed; did you mean"""),
        ('kind = "success"', "# none", "requirements[2].kind: is missing"),
        ("mean_k = 0.10", "mean_k = 0.10\nrepeats = 3", "to the top of the file or [[trials]] ("),
        ('detectors = ["thesis"]', "limit_mm = 3", "unknown key; it belongs to [[requirements]] ("),
        ("limit_mm = 5.0", "limit_mm = -5.0", "requirements[1].limit_mm"),
        ('name = "overlapping"', 'name = "non-vertical"', "two have the name"),
        ("rate = 0.95", "rate = 1.0", "rate"),
        ("window_s = 600.0", "window_s = 600.0\nwindov_s = 1", 'did you mean "window_s"'),
        ("mean_k = 0.10", "mean_k = 0.30", "bath.mean_k: 0.3 K is above leave_k = 0.15 K"),
    ],
)
def test_a_wrong_script_says_where(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "script.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    error = refused(read_config, path, Script)
    assert message in str(error)
    before = path.read_text(encoding="utf-8").partition(new)[0]
    line = 1 + before.count("\n") + new.count("\n")
    assert any(abs(fault.line - line) <= 2 for fault in error.faults)


def test_a_default_that_no_longer_fits_is_a_fault(tmp_path: Path) -> None:
    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    path = tmp_path / "script.toml"
    path.write_text(text.replace("mean_k = 0.10", "leave_k = 0.05"), encoding="utf-8")
    assert "bath.mean_k: 0.1 K is above leave_k = 0.05 K" in str(refused(load_script, path))


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("90", "90 degC is outside what the rig allows (20 to 36 degC)"),
        ("nan", "input should be a finite number"),
        ('"33"', "input should be a valid number (found '33')"),
    ],
)
def test_a_set_point_that_is_refused_is_shown_in_its_place(
    tmp_path: Path, value: str, why: str
) -> None:
    lines = find_script(None).read_text(encoding="utf-8").split("\n")
    at = next(i for i, line in enumerate(lines) if line.startswith("set_point_c"))
    lines[at] = f"set_point_c = {value}"
    path = tmp_path / "script.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    fault, shown, caret = str(refused(load_script, path, (20.0, 36.0))).split("\n")[1:]
    assert fault.startswith(f"{path}:{at + 1}: bath.set_point_c: {why}")
    assert shown[caret.index("^") : caret.rindex("^") + 1] == value


@pytest.mark.parametrize(
    "line", ['seed = "{}"', 'profile = "{}"', "{} = 1", '{} = "{}', "seed = [{}1]", 'baud = "{}"']
)
@pytest.mark.parametrize("name", ["rig.toml", "answers.txt"])
def test_an_endless_line_is_not_printed_whole(tmp_path: Path, line: str, name: str) -> None:
    path = tmp_path / name
    long = ("1, " if "[" in line else "abc") * 30_000
    path.write_text(f"[arm]\n{line.format(long, long)}", encoding="utf-8")
    why = str(refused(load_rig if name == "rig.toml" else load_answers, path))
    assert len(why) < 5000
    assert f"{path}:2: " in why or name != "rig.toml"


def test_a_fault_far_to_the_right_is_shown_with_what_is_around_it(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(f'bath = {{ url = "{"x" * 5000}", ? }}', encoding="utf-8")
    shown, caret = str(refused(load_rig, path)).split("\n")[-2:]
    assert shown[caret.index("^")] == "?"
    assert len(shown) < 200


def test_names_that_are_not_there_list_what_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r'"six-situations"\? Shipped: '):
        find_script("six-situation")
    with pytest.raises(ConfigError, match=r'no trial script "nosuch"\. Shipped: '):
        find_script("nosuch")
    with pytest.raises(
        ConfigError,
        match=r'no rig "nosuch"\. Shipped: emulated, emulated-browser, emulated-depth; or',
    ):
        find_rig("nosuch")
    with pytest.raises(ConfigError, match='"six-situations"'):
        find_script("six")
    with pytest.raises(ConfigError, match="is a folder"):
        find_rig(str(tmp_path))
    (tmp_path / "nine.toml").touch()
    with pytest.raises(ConfigError, match=rf'in {tmp_path}; did you mean "nine"'):
        load_rig(tmp_path / "none.toml")


def test_bytes_that_are_no_utf8_are_named(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(b'name = "\xff"\n')
    with pytest.raises(ConfigError, match="UTF-8"):
        load_rig(path)


def test_what_is_missing_at_the_top_shows_no_line_that_is_right(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('name = "mine"\ncolour = 1\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="calibration: is missing") as caught:
        load_rig(path)
    text = str(caught.value)
    assert ("mine" in text, text.count(" | "), "| colour = 1" in text) == (False, 2, True)


def test_places_of_arrays_strings_and_tables() -> None:
    text = (
        'a = [\n  [1, 2],\n]\nt = """\n[no]\nx = 1\n"""\n[b.c]\nkey = 1 # ]\n[[d]]\nk = 1\n[[d]]\nk'
        ' = { z = 1 }\n"quoted key" = 2\n'
    )
    places = find_places(text)
    assert places["b", "c", "key"].line == 9
    assert places["d", 0, "k"].line == 11
    assert places["d", 1, "k"].line == 13
    assert places["d", 1, "quoted key"].line == 14
    assert ("no",) not in places
    assert nearest(places, ("d", 1, "k", "z")) == (places["d", 1, "k"], False)
