"""Finding a plant by name, and keeping several apart."""

import ast
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mfc_gym import plant
from mfc_gym.systems import SYSTEMS
from mfc_gym.systems.perturbed_chain import perturbed_chain

PACKAGE = Path(plant.__file__).parent


def test_what_a_plant_tells() -> None:
    built = plant.load("PerturbedChain", order=4)
    assert (built.order, built.state) == (4, ("x1", "x2", "x3", "x4"))
    assert built.theta == ("alpha1", "alpha2", "alpha3")
    low, high = built.theta_set
    np.testing.assert_array_equal([low, high], [[-0.5] * 3, [0.5] * 3])
    assert built.task == built.system.task
    assert built.kernel.STATE == built.nominal.STATE


@pytest.mark.parametrize("input_limit", [4.0, 400.0])
def test_the_region_of_the_chain_ends_at_no_return(input_limit: float) -> None:
    """While abs(u) <= input_limit, x_n > sqrt(input_limit) escapes: the region is -10 ... min(10, sqrt(input_limit))."""
    low, high = plant.load("PerturbedChain").region(input_limit)
    np.testing.assert_array_equal(low, [-10, -10, -10])
    np.testing.assert_array_equal(high, [10, 10, min(10, np.sqrt(input_limit))])


def test_plants_in_one_process_are_independent() -> None:
    """Loading one does not touch what another computes; equal options give the same modules, different ones others."""
    x, theta = np.array([1.0, 2.0, 3.0]), np.array([0.25, -0.5])
    chain = plant.load("PerturbedChain")
    before = chain.kernel.uncertainty_at(x, theta)
    two, four = plant.load("PerturbedChain", order=2), plant.load("PerturbedChain", order=4)
    wide, duffing = plant.load("PerturbedChain", rho=0.5), plant.load("Duffing")
    assert plant.load("PerturbedChain").kernel is chain.kernel
    assert plant.load("mfc_gym.systems.duffing:duffing").state == duffing.state
    modules = [m for p in (chain, two, four, wide, duffing) for m in (p.kernel, p.nominal)]
    assert len({m.__name__ for m in modules}) == 10
    np.testing.assert_array_equal(chain.kernel.uncertainty_at(x, theta), before)
    np.testing.assert_array_equal(two.kernel.output_derivatives(*x[:2], theta[0]), [1.0, 2.5])
    np.testing.assert_array_equal(four.kernel.output_derivatives(*np.ones(4), *np.zeros(3)), np.ones(4))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "Unknown",
            {},
            r"`system` must be one of \[.*'PerturbedChain'.*\], a module:attribute or a .toml file, got 'Unkn",
        ),
        (None, {}, "`system` must be one of .*, got None"),
        (3, {}, "`system` must be one of .*, got 3"),
        ("no_such.module:plant", {}, "`system` must name an importable module, got 'no_such.module:plant'"),
        (":plant", {}, "`system` must name an importable module, got ':plant'"),
        ("plants:missing", {}, "`system` must name a function of the module plants, got 'plants:missing'"),
        ("plants:not_a_plant", {}, "`system` must name a function of the module plants, got 'plants:not_a_plant'"),
        ("missing.toml", {}, "there is no file 'missing.toml'"),
        ("PerturbedChain", {"colour": "red"}, "its system 'PerturbedChain' .* takes what is given: .*colour"),
        ("PerturbedChain", {"order": np.int64(3)}, "options of the system must be numbers, strings, lists or dicts"),
        ("PerturbedChain", {"order": 1}, "`order` must be an integer from 2 to 32, got 1"),
        ("PerturbedChain", {"order": True}, "`order` must be an integer from 2 to 32, got True"),
        ("PerturbedChain", {"order": 33}, "`order` must be an integer from 2 to 32, got 33"),
        ("PerturbedChain", {"order": 3.0}, r"`order` must be an integer from 2 to 32, got 3\.0"),
        ("PerturbedChain", {"rho": 1.0}, r"`rho` must lie in \[0, 1\), got 1\.0"),
        ("PerturbedChain", {"rho": float("nan")}, r"`rho` must lie in \[0, 1\), got nan"),
    ],
)
def test_refused(name: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plant.load(name, **options)


def test_a_plant_file_may_change_while_the_process_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "plant.toml"
    monkeypatch.setattr(plant, "build_system", lambda name, options: perturbed_chain(int(Path(name).read_text())))
    orders = []
    for text in ("2", "3", "2"):
        file.write_text(text)
        orders.append(plant.load(str(file)).order)
    assert orders == [2, 3, 2]


def imported(module: str) -> set[str]:
    """Modules of the package that this one imports, without the package's name."""
    path = PACKAGE / f"{module}.py"
    tree = ast.parse(path.read_text()) if path.exists() else ast.Module([], [])
    names = [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    return {n.split(".")[1] for n in names if n.startswith("mfc_gym.")}


def test_cached_kernels_know_all_that_they_came_from() -> None:
    """Every module that takes part in writing kernels is in the hash: none can change and leave old kernels behind."""
    found, pending = set(), {"code_generation", "plant_file", "enclosure"}
    while pending:
        found |= pending
        pending = {m for module in pending for m in imported(module)} - found
    written = {m for m in found if (PACKAGE / f"{m}.py").exists() and m != "plant"}
    assert written <= set(plant.GENERATORS)


def test_every_registered_plant_can_be_imported() -> None:
    for name, location in SYSTEMS.items():
        assert plant._module_file(name).name == location.partition(":")[0].rpartition(".")[2] + ".py"


def test_a_name_is_never_executed() -> None:
    """The name of `every_function` closes a docstring and then exits."""
    built = plant.load("plants:every_function")
    assert "raise SystemExit" in built.kernel.NAME
    assert built.kernel.NAME == built.nominal.NAME == built.system.name
    assert built.kernel.__name__ in sys.modules
