"""PATH:1,3 names members of a population."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.small import kitchen

from popgen.errors import UserError
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import PopulationWriter
from popgen.population.chosen_members import join_members, load_members, split_members


def write(path: Path, members: int) -> Path:
    writer = PopulationWriter(path, kitchen().spec, method="mappo", config_digest="0" * 64, seed=0)
    for seed in range(members):
        writer.add_member(RandomPolicy(6), seed=seed, steps={})
    return path


@pytest.mark.parametrize(
    ("text", "path", "members"),
    [
        ("runs/a", "runs/a", ()),
        ("runs/a:2", "runs/a", (2,)),
        ("runs/a:3,1", "runs/a", (3, 1)),
        ("runs/a:1,", "runs/a", (1,)),
        ("runs/a:b:4", "runs/a:b", (4,)),
        ("runs/a:,", "runs/a:,", ()),
        ("runs/a:b", "runs/a:b", ()),
        ("runs/a:-1", "runs/a:-1", ()),
        ("runs/a:1 2", "runs/a:1 2", ()),
        (":1", ":1", ()),
    ],
)
def test_numbers_behind_the_last_colon_are_members(text: str, path: str, members: tuple[int, ...]) -> None:
    assert split_members(text) == (path, members)


def test_what_is_joined_is_split_again() -> None:
    assert split_members(join_members("runs/a b:c", (3, 1))) == ("runs/a b:c", (3, 1))


def test_a_path_that_exists_is_no_choice(tmp_path: Path) -> None:
    for name, members in (("a", 3), ("a:2", 1), ("b:x", 2)):
        write(tmp_path / name, members)
    assert load_members(f"{tmp_path}/a:2").population.path == tmp_path / "a:2"
    assert load_members(f"{tmp_path}/a:2,").members == (2,), "which does not exist"
    assert load_members(f"{tmp_path}/a:2:1").members == (1,)
    assert load_members(f"{tmp_path}/b:x").members == (1, 2)


def test_all_members_or_those_that_are_named_in_their_order(tmp_path: Path) -> None:
    path = write(tmp_path / "a", 3)
    everyone, some = load_members(str(path)), load_members(f"{path}:3,1")
    assert (everyone.members, everyone.named) == ((1, 2, 3), False)
    assert (some.members, some.named, len(some.population)) == ((3, 1), True, 3)
    for numbers, told in (("4", "has no member 4; .*a has 3"), ("0", "no member 0"), ("1,1", "names a member twice")):
        with pytest.raises(UserError, match=told) as caught:
            load_members(f"{path}:{numbers}", "ego.partners")
        assert caught.value.field == "ego.partners"
        with pytest.raises(UserError, match=told) as caught:
            load_members(f"{path}:{numbers}")
        assert caught.value.field == f"{path}:{numbers}"
    with pytest.raises(UserError, match="nowhere: is not a population"):
        load_members(f"{tmp_path}/nowhere:1")
