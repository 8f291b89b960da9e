"""`popgen bench ego`: speed beside partners of each kind, and who has none."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from popgen.pipelines.bench_ego import KINDS

Run = Callable[..., tuple[int, str, str]]
SMALL = ("scale=smoke", "ego.envs=2", "cluster.threads=1", "--partners", "1", "--seconds", "0.01")


@pytest.mark.end_to_end
def test_an_ego_is_measured_beside_partners_of_each_kind(run: Run) -> None:
    code, out, err = run("bench", "ego", *SMALL, "--json")
    assert code == 0, err
    report = json.loads(out)
    assert (report["method"], report["partners"], report["threads"]) == ("ego_fcp", 1, 1)
    assert set(report["kinds"]) == set(KINDS)
    for row in report["kinds"].values():
        assert row["steps"] >= 2 * 40 and 0.0 < row["rollout"] < 1.0  # an iteration of two environments, 40 steps each
        assert row["steps_per_second"] == pytest.approx(row["steps"] / row["seconds"], rel=0.1)  # of rounded seconds


@pytest.mark.parametrize("method", ["sp", "xpm_sim"])
def test_a_method_without_partners_is_refused(run: Run, method: str) -> None:
    code, _, err = run("bench", "ego", f"method={method}", *SMALL[2:])
    assert code == 2 and err.startswith("popgen: error: method: ") and "has no partners" in err
