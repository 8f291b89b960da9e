"""Recipes are complete, say the same to whoever asks, and set nothing that their method lacks."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from conftest import ROOT

import popgen
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig, field_names
from popgen.envs import env_names, make_env
from popgen.errors import UserError
from popgen.methods import registry
from popgen.methods.method import Method
from popgen.methods.recipe import Recipe, because
from popgen.methods.registry import METHODS, find_method

KITCHENS = [name for name in env_names() if name.startswith("overcooked/")]
SPECS = {name: make_env(name, 1).spec for name in env_names()}
THOROUGH = ("xpm_wm", "xpm_sim", "lipo")

BASE = Recipe("base", "", {"a.x": 1, "a.y": 2}, {"ring": {"a.x": because(3, "narrow")}})
SHORT = Recipe("short", "", {"a.y": 4}, {"ring": {"a.z": 5}}, base=BASE)


def test_a_row_goes_over_its_recipe_and_a_recipe_over_the_row_of_its_base() -> None:
    assert BASE.values("room") == {"a": {"x": 1, "y": 2}}
    assert BASE.values("ring") == {"a": {"x": 3, "y": 2}}
    assert SHORT.values("room") == {"a": {"x": 1, "y": 4}}
    assert SHORT.values("ring") == {"a": {"x": 3, "y": 4, "z": 5}}
    listed = SHORT.list_settings("ring")["a.x"]
    assert (listed.source, listed.setting.reason) == ("layout row of base", "narrow")


@pytest.mark.parametrize("method", METHODS)
def test_the_library_and_the_command_line_get_the_same_numbers_on_every_layout(method: str) -> None:
    place = list(METHODS).index(method)
    with_row = METHODS[method].recipes["laptop"].by_layout
    pairs = [("laptop", env) for env in env_names()]
    # The demo takes the laptop's rows, which the next test compares on every layout.
    pairs += [("demo", env) for env in (*list(with_row)[:2], "rendezvous/mppmr")]
    others = [("paper", "overcooked/coordination_ring"), ("smoke", "rendezvous/mppmr")]
    # Hydra takes its time: everything for one method of each package of rows, something for each of the others.
    for scale, env in [*pairs, *others] if method in THOROUGH else [pairs[place % len(pairs)]]:
        ours = popgen.recipe(method, env, scale).as_dict()
        theirs = RunConfig.parse(compose([f"method={method}", f"scale={scale}", f"env={env}"])).as_dict()
        assert {**ours, "env": None} == {**theirs, "env": None}, (scale, env)
        assert ours["env"]["name"] == theirs["env"]["name"]


@pytest.mark.parametrize("method", METHODS)
def test_the_demo_is_the_laptops_recipe_with_the_layouts_row_but_for_what_it_sets(method: str) -> None:
    demo = METHODS[method].recipes["demo"]
    for env in env_names():
        own = {"scale"} | {name for name, set_ in demo.list_settings(env).items() if set_.source.endswith("demo")}
        short, whole = (flat(popgen.recipe(method, env, scale).as_dict()) for scale in ("demo", "laptop"))
        assert {name for name, value in short.items() if whole[name] != value} <= own


@pytest.mark.parametrize("method", METHODS)
def test_recipes_set_fields_of_their_method_on_layouts_that_there_are(method: str) -> None:
    found = METHODS[method]
    fields = set(field_names(found.config))
    for recipe in found.recipes.values():
        rows = recipe.by_layout
        assert set(rows) <= set(env_names())
        assert {name for settings in (recipe.settings, *rows.values()) for name in settings} <= fields


@pytest.mark.parametrize("method", [name for name in METHODS if not METHODS[name].trains_ego])
def test_every_recipe_of_a_generator_can_be_run_as_it_stands(method: str) -> None:
    found = METHODS[method]
    for scale, recipe in found.recipes.items():
        for env in {*KITCHENS, *recipe.by_layout}:
            found.check(popgen.recipe(method, env, scale), SPECS[env])


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


def test_names_that_there_are_not_are_refused_with_the_closest() -> None:
    with pytest.raises(UserError, match="did you mean lipo"):
        find_method("lipoo")
    with pytest.raises(UserError, match="choose one of laptop"):
        popgen.recipe("lipo", scale="huge")


class Entry:
    """An entry point that gives an object, or raises."""

    def __init__(self, name: str, given: Any) -> None:
        self.name, self.value, self.given = name, "package:METHOD", given

    def load(self) -> Any:
        if isinstance(self.given, Exception):
            raise self.given
        return self.given


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> Any:
    """`offer(entries)` makes distributions offer these, for this test."""

    def offer_entries(*entries: Entry) -> None:
        monkeypatch.setattr(
            registry, "_find_offered", lambda: {e.name: e for e in entries if e.name not in registry.BUILT_IN}
        )
        registry._load_method.cache_clear()

    yield offer_entries
    registry._load_method.cache_clear()


def test_an_installed_method_joins_the_others_and_cannot_take_a_built_in_name(offer: Any) -> None:
    toy = Method(**{**vars(METHODS["mappo"]), "name": "toy", "title": "Toy"})
    offer(Entry("toy", toy), Entry("lipo", toy))
    assert list(METHODS)[-1] == "toy" and len(METHODS) == len(registry.BUILT_IN) + 1
    assert METHODS["toy"] is toy and METHODS["lipo"].title == "LIPO"


@pytest.mark.parametrize("given", [ImportError("no torch"), "text", METHODS["mappo"]], ids=["error", "text", "name"])
def test_a_broken_package_spoils_its_own_method_only(offer: Any, given: Any) -> None:
    offer(Entry("toy", given))
    with pytest.raises(UserError, match="repair its package"):
        find_method("toy")
    assert RunConfig.parse(compose(["method=lipo"])).method == "lipo"


def test_records_of_all_methods_are_read_without_what_only_training_needs() -> None:
    program = (
        "import sys\n"
        "sys.modules |= dict.fromkeys(('ray', 'mlflow', 'torch', 'hydra'))\n"
        "from popgen.methods.registry import METHODS\n"
        "print(len([METHODS[name] for name in METHODS]))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == str(len(registry.BUILT_IN)), done.stderr


def test_a_layout_without_its_family_is_refused() -> None:
    """The laptop's numbers without the layout's row are no answer."""
    with pytest.raises(UserError, match="overcooked/cramped_room"):
        popgen.recipe("xpm_wm", "cramped_room")
