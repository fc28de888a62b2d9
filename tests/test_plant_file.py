"""Plant files: what a good one gives, and that a bad one is refused in one sentence with the line that is wrong."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from mfc_gym.enclosure import region_box
from mfc_gym.flat_system import BOUNDS
from mfc_gym.plant_file import load_plant
from mfc_gym.systems.perturbed_chain import perturbed_chain
from mfc_gym.task import Task
from mfc_gym.toml_lines import line_numbers

PLANTS = sorted(Path(__file__).parents[1].glob("docs/plants/*.toml"))
GOOD = """\
name = "chain"
state = ["x1", "x2"]
f = ["x2", "-k*x1"]
g = [0, 1]
Delta = [
  "eps*x2",
  0,
]
h = "x1"

[parameters]
k = 2.0

[theta]
eps = [-0.2, 0.2]

[region]
x1 = [-3, 3]

[bounds]
delta_3 = 0.2

[task]
initial_state = [1.0, 0.0]
dt = 0.02
"""
CODE = "__import__('os').environ.__setitem__('PLANT_FILE_RAN_CODE', '1')"
UNITY = "(sin(x1*x2 + x1)^2 + cos(x1*x2 + x1)^2)"
DEEP = "[" * 2000 + "]" * 2000

# (what it is, replaced, by, line that is named or None, what the message says)
BAD = [
    ("code in an expression", '"-k*x1"', f'"{CODE}"', 3, "the name '__import__' is unknown, in column 1"),
    ("code as the output", 'h = "x1"', f'h = "{CODE}"', 9, "the name '__import__' is unknown"),
    ("an attribute", '"-k*x1"', '"x1.__class__"', 3, "'.' is not allowed here, in column 3"),
    ("a subscript", '"-k*x1"', '"x1[0]"', 3, r"'\[' is not allowed here"),
    ("a lambda", '"-k*x1"', '"(lambda: x1)()"', 3, "the name 'lambda' is unknown"),
    ("a huge exponent", '"-k*x1"', '"x1^99999999"', 3, "an exponent must be a number up to 16"),
    ("a power tower", '"-k*x1"', '"9**9**9**9"', 3, "an exponent must be a number up to 16"),
    ("powers of powers", '"-k*x1"', '"((x1^16 + 1)^16 + 1)^16"', 3, "too many terms"),
    ("nested exponentials", '"-k*x1"', '"exp(exp(exp(exp(x1))))"', 3, "grows too fast"),
    ("deep nesting", '"-k*x1"', f'"{"(" * 900}x1{")" * 900}"', 3, "too deeply nested"),
    ("a long sum", '"-k*x1"', f'"{"x1*x2+" * 300}x1"', 3, "too long or too deeply nested"),
    ("an endless expression", '"-k*x1"', f'"{"x1+" * 5000}x1"', 3, "may have 2000 characters"),
    ("an overflowing number", '"-k*x1"', '"1e999*x1"', 3, "the number 1e999 is out of range"),
    ("a number of many digits", '"-k*x1"', f'"{"9" * 500}"', 3, "is out of range"),
    ("a look-alike name", '"-k*x1"', '"\u0445' + '1"', 3, "is not allowed here"),
    ("a full-width digit", '"-k*x1"', '"x\uff11"', 3, "the name 'x' is unknown"),
    ("theta outside Delta", '"-k*x1"', '"-eps*x1"', 3, "the name 'eps' is unknown"),
    ("a look-alike state", '["x1", "x2"]', '["x1", "\u0445' + '2"]', 2, "a name must be a letter"),
    ("a missing state", '["x1", "x2"]', '["x1"]', 2, "`state` must have 2 to 12 entries, got 1"),
    ("no state at all", 'state = ["x1", "x2"]\n', "", None, "the entry `state` is missing"),
    ("a state of another type", '["x1", "x2"]', '["x1", 2]', 2, "a name must be a letter"),
    ("too many states", '["x1", "x2"]', str([f"x{i}" for i in range(13)]), 2, "must have 2 to 12 entries, got 13"),
    ("a keyword as a name", "k = 2.0", "lambda = 2.0", 12, "a name must be a letter"),
    ("a dunder name", "k = 2.0", "a__b = 2.0", 12, "a name must be a letter"),
    ("a function as a name", "k = 2.0", "sin = 2.0", 12, "'sin' is a function or reserved"),
    ("a name that stands for two things", "eps = [-0.2", "x1 = [-0.2", 15, "the name 'x1' stands for two things"),
    ("a key given twice", "k = 2.0", "k = 2.0\nk = 3.0", 13, "not valid TOML: Cannot overwrite a value"),
    ("too short a list", "g = [0, 1]", "g = [1]", 4, "`g` must be a list of 2 entries, got 1 entries"),
    ("an unknown key", "k = 2.0", "k = 2.0\n\n[colour]\nred = 1", 14, "'colour' is no key of a plant file"),
    ("an unknown bound", "delta_3 = 0.2", "delta_9 = 0.2", 21, r"'delta_9' is no key of \[bounds\]"),
    ("an unknown task key", "dt = 0.02", "step = 0.02", 25, r"'step' is no key of \[task\]"),
    ("a region for no state", "x1 = [-3, 3]", "y = [-3, 3]", 18, r"'y' is no key of \[region\]"),
    ("an empty interval", "eps = [-0.2, 0.2]", "eps = [0.2, -0.2]", 15, "with low < high"),
    ("an empty region", "x1 = [-3, 3]", "x1 = [3, -3]", 18, r"got x1: \(3, -3\)"),
    ("not a number", "eps = [-0.2, 0.2]", "eps = [nan, 0.2]", 15, "must be a number of moderate size, got nan"),
    ("an infinite parameter", "k = 2.0", "k = inf", 12, "must be a number of moderate size, got inf"),
    ("a huge integer", "k = 2.0", f"k = {'9' * 3000}", 12, "must be a number of moderate size"),
    ("a truth value", "k = 2.0", "k = true", 12, "`k` must be a number of moderate size, got True"),
    ("a date", "k = 2.0", "k = 1979-05-27", 12, "must be a number of moderate size"),
    ("a negative sampling time", "dt = 0.02", "dt = -1", 25, "`dt` must be a positive number"),
    ("an initial state outside", "[1.0, 0.0]", "[1.0, 99.0]", 24, "must lie in the region, got x2 = 99.0"),
    ("no flat output", 'h = "x1"', 'h = "x2"', 9, "must give relative degree n = 2: L_g L_f.0 h must be zero, got 1"),
    ("no input", "g = [0, 1]", "g = [0, 0]", 4, "must give relative degree n = 2: L_g L_f.1 h must be nonzero"),
    (
        "a vanishing input gain",
        '"x2", "-k*x1"',
        '"x2^2/2", "-k*x1"',
        4,
        "input gain .* other than zero .*: x2 vanishes",
    ),
    (
        "Delta kills the input",
        '"eps*x2",',
        '"-x2",',
        5,
        r"relative degree n = 2: L_g L_\(f\+Delta\).1 h must be nonzero",
    ),
    ("a pole in the region", '"-k*x1"', '"1/(x1 - 1)"', 3, "f` entry 2 must be defined .*: x1 - 1 changes its sign"),
    ("a root of negative numbers", '"-k*x1"', '"sqrt(x1 + 1)"', 3, r"x1 \+ 1 is not nonnegative at x1 = -3"),
    ("a parameter that divides by zero", '"-k*x1"', '"x1/(k - 2)"', 3, "the values of its parameters: .* not a finite"),
    ("a constant 1/0", '"-k*x1"', '"x2/(1 - 1)"', 3, "not a finite real number"),
    (
        "a wrong bound",
        "delta_3 = 0.2",
        'delta_3 = 0.2\ndelta_1 = "0.3*abs(x1)"',
        22,
        r"delta_1 must bound abs\(Delta_1\): .* exceeds",
    ),
    ("a bound of 1", "delta_3 = 0.2", "delta_3 = 1", 21, "must have delta_3 < 1"),
    ("too large a set", "eps = [-0.2, 0.2]\n", "eps = [-0.5, 1.0]\n", 15, "nominal input gain is 1.25 times"),
    ("a file that never ends", "name =", "#" + "x" * 70_000 + "\nname =", None, "may have 65536 bytes"),
    ("nested lists", '"-k*x1"', DEEP, None, "nested too deeply"),
    ("nested lists in TOML's limits", '"-k*x1"', "[" * 40 + "]" * 40, 3, "must be a number of moderate size"),
    (
        "an endless dotted key",
        "k = 2.0",
        "k" + ".k" * 9000 + " = 2.0",
        12,
        "a line may have 300 dots, this one has 9001",
    ),
    ("no TOML", "name =", "name ==", 1, "not valid TOML"),
    ("too many terms", '"x2", "-k*x1"', '"x2*(x1 + x2 + 1)^16/(x1^2 + x2^2 + 1)^16", 0', 3, "too many terms"),
    (
        "growing derivatives",
        '"x2", "-k*x1"',
        '"x2*(x1 + x2 + 1)^9*(exp(x1*x2) + sin(x1*x2) + x1)^6", 0',
        3,
        "grow too large",
    ),
    ("an undecidable degree", 'h = "x1"', f'h = "x1 + x2*({UNITY} - 1)*({UNITY} + x1)"', 9, "cannot be decided"),
]


def write(directory: Path, replaced: str, by: str) -> Path:
    text = GOOD.replace(replaced, by)
    assert text != GOOD
    if by.startswith("eps = [-0.5"):
        text = text.replace("delta_3 = 0.2\n", "")  # nothing says which part of the set counts
    path = directory / "plant.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(("replaced", "by", "line", "message"), [c[1:] for c in BAD], ids=[c[0] for c in BAD])
def test_a_bad_file_is_refused_with_its_line(
    tmp_path: Path, replaced: str, by: str, line: int | None, message: str
) -> None:
    path = write(tmp_path, replaced, by)
    place = "" if line is None else f", line {line}"
    with pytest.raises(ValueError, match=message) as refusal:
        load_plant(path)
    sentence = str(refusal.value)
    assert sentence.startswith(f"{path}{place}: ")
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert len(sentence) < 600
    assert "PLANT_FILE_RAN_CODE" not in os.environ


def test_a_kink_that_is_differentiated_twice_is_refused(tmp_path: Path) -> None:
    """abs(x1) in the first of two rows has the derivative sign(x1); in the first of three rows that is differentiated."""
    path = tmp_path / "plant.toml"
    two = 'name = "a"\nstate = ["x1", "x2"]\nf = ["x2 + abs(x1)", 0]\ng = [0, 1]\nDelta = [0, 0]\nh = "x1"\n'
    path.write_text(two)
    assert load_plant(path).bounds["delta_1"] == 0
    path.write_text(
        two.replace('"x2"]', '"x2", "x3"]')
        .replace("0]", "0, 0]")
        .replace("[0, 1]", "[0, 0, 1]")
        .replace(", 0, 0]", ', "x3", 0]', 1)
    )
    with pytest.raises(ValueError, match="line 3: `f` must be smoother"):
        load_plant(path)


def test_what_a_good_file_gives(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(GOOD)
    system = load_plant(path)
    x1, x2 = system.x
    (eps,) = system.theta_symbols
    assert (system.name, system.state, system.h) == ("chain", ("x1", "x2"), x1)
    assert system.f == (x2, -2 * x1)
    assert system.g == (0, 1)
    assert system.Delta == (eps * x2, 0)
    assert system.theta == {"eps": (-0.2, 0.2)}
    assert system.region["x1"] == (-3, 3)
    assert system.task == Task(initial_state=(1.0, 0.0), dt=0.02)
    # y'' = (1 + eps) (u - 2 x1): Delta_1 = -2 eps x1, Delta_3 = eps
    assert system.bounds == {
        "delta_1": sp.Rational(2, 5) * abs(x1),
        "delta_3": sp.Rational(1, 5),
        "delta_m": 0,
        "sharp_1": abs(x1) / 2,
        "sharp_3": sp.Rational(1, 4),
    }


@pytest.mark.parametrize("path", PLANTS, ids=lambda p: p.stem)
def test_the_bounds_of_the_examples_hold(path: Path, rng: np.random.Generator) -> None:
    """Delta_1, Delta_3, phi_m and the quotients by 1 + Delta_3 stay below their bounds at random admissible points."""
    system = load_plant(path)
    low, high = np.array([*region_box(system).values(), *system.theta.values()]).T
    points = rng.uniform(low, high, (4096, len(low)))
    symbols = [*system.x, *system.theta_symbols]
    Delta_1, Delta_3, phi_m, *bounds = (
        np.broadcast_to(value, len(points))
        for value in sp.lambdify(
            symbols, [system.Delta_1, system.Delta_3, system.phi_m, *(system.bounds[k] for k in BOUNDS)]
        )(*points.T)
    )
    inside = np.abs(Delta_3) <= bounds[1]
    assert inside.sum() > 1000
    values = [Delta_1, Delta_3, phi_m, Delta_1 / (1 + Delta_3), Delta_3 / (1 + Delta_3)]
    for value, bound in zip(values, bounds, strict=True):
        assert (np.abs(value) <= bound * (1 + 1e-9) + 1e-9)[inside].all()


def test_the_chain_from_a_file_is_the_chain_of_the_library() -> None:
    file = load_plant(next(p for p in PLANTS if p.stem == "perturbed_chain"))
    library = perturbed_chain()
    for key in ("state", "f", "g", "h", "Delta", "theta"):
        assert getattr(file, key) == getattr(library, key)
    assert region_box(file) == region_box(library)
    assert file.region["x3"] == library.region["x3"]
    assert (file.task.theta, file.task.initial_state) == (library.task.theta, library.task.initial_state)
    ones = dict.fromkeys(file.x, 1)
    for key, bound in library.bounds.items():
        assert float(file.bounds[key].subs(ones)) == pytest.approx(float(bound.subs(ones)), rel=1e-9)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"", b"\x00", b"name = 1", b"[[f]]", b"f.f.f = 1"])
def test_bytes_that_are_no_plant(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "plant.toml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"^{path}[,:] .*\.$"):
        load_plant(path)


@pytest.mark.parametrize("name", ["missing.toml", "."])
def test_no_file(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="there is no such file"):
        load_plant(tmp_path / name)


@settings(max_examples=60)
@given(st.data())
def test_a_damaged_file_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    text = list(GOOD)
    for _ in range(data.draw(st.integers(1, 3))):
        position = data.draw(st.integers(0, len(text) - 1))
        text[position] = data.draw(st.sampled_from("[]{}=\"',.#\n0x12keps+-*/^() \\")) * data.draw(st.integers(0, 2))
    path = tmp_path_factory.mktemp("damaged") / "plant.toml"
    path.write_text("".join(text))
    try:
        load_plant(path)
    except ValueError as error:
        assert str(error).startswith(f"{path}")  # noqa: PT017 (either outcome is right)


def test_line_numbers() -> None:
    text = (
        'a = 1  # a comment with ] and "\n'
        "b = [ # first\n"
        '  "[x", # ]\n'
        "  [2, 3], '''\ntwo lines''',\n"
        "  4,\n"
        "]\n"
        '"c d".e = { f = [1,\n'
        '  2], g = "}" }\n'
        "\n"
        "[t.u]\n"
        "v = 1979-05-27 07:32:00\n"
        "w = -1.5e3\n"
    )
    tomllib.loads(text)
    expected: dict[tuple[str | int, ...], int] = {
        ("a",): 1, ("b",): 2, ("b", 0): 3, ("b", 1): 4, ("b", 1, 0): 4, ("b", 1, 1): 4, ("b", 2): 4, ("b", 3): 6,
        ("c d",): 8, ("c d", "e"): 8, ("c d", "e", "f"): 8, ("c d", "e", "f", 0): 8, ("c d", "e", "f", 1): 9,
        ("c d", "e", "g"): 9, ("t",): 11, ("t", "u"): 11, ("t", "u", "v"): 12, ("t", "u", "w"): 13,
    }  # fmt: skip
    assert line_numbers(text) == expected
