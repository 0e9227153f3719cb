"""A study in parts on several machines is the study on one machine."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.errors import WorkerDied
from fpirhc.studies.scenarios import ledger as ledgers
from fpirhc.studies.scenarios import scenario_study
from fpirhc.studies.scenarios.bench import RecordFields
from fpirhc.studies.scenarios.ledger import Ledger, header_of
from fpirhc.studies.scenarios.scenario_study import LEDGER, compare_scenarios, merge_shards

STUDY = ("mrac_pendulum", "--scenarios", "7", "--mismatch", "20", "--controllers", "CTC", "CTC+FPI", "--no-compile")


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> Path:
    """A folder with the whole study, and with its three parts."""
    folder = tmp_path_factory.mktemp("shards")
    assert main(["compare", *STUDY, "--out", str(folder / "whole")]) == 0
    for k in (1, 2, 3):
        assert main(["compare", *STUDY, "--shard", f"{k}/3", "--out", str(folder / f"part{k}")]) == 0
    return folder


def results(folder: Path) -> dict[tuple[str, int], dict[str, object]]:
    """The records of a folder without the times that they took, by controller and scenario."""
    _, *lines = (folder / LEDGER).read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    return {
        (r["controller"], r["scenario"]): {n: r[n] for n in ("error", "metrics", "outcome", "mismatch")}
        for r in records
    }


def test_parts_have_every_third_scenario_and_join_to_the_whole(parts, tmp_path, capsys):
    """Bit by bit, and the report of the joined folder has nothing left to run."""
    assert {number for _, number in results(parts / "part2")} == {1, 4}
    assert main(["merge", *(str(parts / f"part{k}") for k in (3, 1, 2)), "--out", str(tmp_path / "all")]) == 0
    said = capsys.readouterr().out
    assert said.startswith("14 results of 7 scenarios, CTC, CTC+FPI\n")
    assert f"without --shard, and with --out {tmp_path / 'all'}" in said.replace("\n", " ")
    assert results(tmp_path / "all") == results(parts / "whole")
    before = (tmp_path / "all" / LEDGER).read_bytes()
    assert main(["compare", *STUDY, "--out", str(tmp_path / "all"), "--json"]) == 0
    joined = json.loads(capsys.readouterr().out)
    assert (tmp_path / "all" / LEDGER).read_bytes() == before
    assert joined["verdict"] == json.loads((parts / "whole" / "results.json").read_text(encoding="utf-8"))["verdict"]


def test_a_result_that_stands_in_two_parts_is_kept_once(parts, tmp_path):
    joined = merge_shards([parts / "part1", parts / "part1", parts / "part2"], tmp_path)
    assert (joined.records, joined.scenarios, joined.twice) == (10, 5, 6)
    again = merge_shards([parts / "part2"], tmp_path)
    assert (again.records, again.twice) == (10, 4)


def test_joining_holds_places_and_checksums_alone(parts, tmp_path, monkeypatch):
    """Thirty bytes a result, some of which is the growth of arrays: 12 for each of the two files, 4 for its place in the whole."""
    monkeypatch.setattr(ledgers, "_BLOCK", 4096)
    header = header_of(parts / "part1" / LEDGER)
    with Ledger(parts / "part1" / LEDGER, header) as part:
        record = part.records[0]

    def most(count: int) -> int:
        folder = tmp_path / f"{count}"
        with Ledger(folder / LEDGER, header) as ledger:
            for number in range(count):
                ledger.append({**record, "scenario": number})
        tracemalloc.start()
        try:
            assert merge_shards([folder], tmp_path / f"all{count}").scenarios == count
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert most(2500) - most(500) < 45 * 2000


def test_parts_that_do_not_belong_together_are_refused(parts, tmp_path, capsys):
    """Another seed, a folder without results, a damaged head, and one result that differs."""
    other, none = tmp_path / "other", tmp_path / "none"
    assert main(["compare", *STUDY, "--shard", "1/3", "--seed", "1", "--out", str(other)]) == 0
    none.mkdir()
    for folder, message in (
        (other, "holds results of something else, and results are never mixed: seed was 1, is 0"),
        (none, "No such file or directory; expected the folder of a comparison of scenarios"),
    ):
        assert main(["merge", str(parts / "part1"), str(folder), "--out", str(tmp_path / "whole")]) == 3
        assert message in " ".join(capsys.readouterr().err.split())
    assert not (none / LEDGER).exists()
    changed = tmp_path / "changed"
    changed.mkdir()
    head, *lines = (parts / "part1" / LEDGER).read_text(encoding="utf-8").splitlines()
    record = json.loads(lines[0])
    (changed / LEDGER).write_text(head + "\n", encoding="utf-8")
    with Ledger(changed / LEDGER, header_of(changed / LEDGER), RecordFields) as ledger:
        del record["sum"]
        ledger.append({**record, "error": 2.0})
    assert main(["merge", str(parts / "part1"), str(changed), "--out", str(tmp_path / "whole")]) == 3
    assert "scenario 0 of 'CTC' has another result than in another folder" in " ".join(capsys.readouterr().err.split())
    (changed / LEDGER).write_text(head[:-3] + "\n", encoding="utf-8")
    assert main(["merge", str(changed), "--out", str(tmp_path / "rest")]) == 3
    assert "line 1 is damaged; run this part again" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("text", ["3", "0/3", "4/3", "1/0", "a/b", "1/3/2"])
def test_a_part_is_named_as_one_of_several(text, capsys):
    assert main(["compare", *STUDY, "--shard", text]) == 2
    assert f"expected K/N with K from 1 to N, such as 3/100, got '{text}'" in " ".join(capsys.readouterr().err.split())


def test_a_part_without_scenarios_is_refused(tmp_path, capsys):
    assert main(["compare", *STUDY, "--shard", "9/9", "--out", str(tmp_path)]) == 2
    assert "shard 9/9 of 7 scenarios has none; use at most 7 shards" in " ".join(capsys.readouterr().err.split())
    assert main(["compare", "mrac_pendulum", "--shard", "1/2"]) == 2
    assert "--shard needs --scenarios N" in capsys.readouterr().err
    with pytest.raises(fp.errors.InvalidValue, match="shard 3/2: expected a part from 1 to 2"):
        compare_scenarios(
            fp.load_problem("mrac_pendulum"), count=4, percent=10.0, shard=(3, 2), seed=0, folder=tmp_path
        )


def test_parts_of_unequal_sizes_belong_together(tmp_path, monkeypatch):
    """Whether scenarios run side by side is a fact of the whole: 63 of them make parts of 32 and of 31."""

    def stopped(*_: object) -> None:
        raise WorkerDied("before the first run")

    monkeypatch.setattr(scenario_study, "_completed", stopped)
    folders, task = [tmp_path / f"part{k}" for k in (1, 2)], fp.load_problem("mrac_pendulum")
    for k, folder in enumerate(folders, 1):
        with pytest.raises(WorkerDied):
            compare_scenarios(task, count=63, percent=10.0, shard=(k, 2), seed=0, folder=folder)
    assert merge_shards(folders, tmp_path / "all").records == 0


def test_the_whole_is_no_part_of_itself(parts, tmp_path, capsys):
    """It keeps what it holds, and the other parts are joined to it."""
    first, second = (str(parts / f"part{k}") for k in (1, 2))
    whole = str(tmp_path / "all")
    assert main(["merge", first, "--out", whole]) == 0
    assert main(["merge", whole, second, "--out", whole]) == 2
    assert "is the folder of the whole and of a part" in " ".join(capsys.readouterr().err.split())
    assert main(["merge", second, "--out", whole]) == 0
    assert results(tmp_path / "all") == {**results(parts / "part1"), **results(parts / "part2")}
