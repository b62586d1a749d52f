from __future__ import annotations

from loopwright.service.store import knowledge
from loopwright.service.store.store import Store
from tests.unit.service.observing.findings import finding


def numbers(store: Store, loop: str = "A") -> list[int]:
    return [each.number for each in knowledge.read(store, loop)]


def test_a_finding_comes_back_as_it_was(store: Store) -> None:
    given = finding(None, None, proposed=None)
    knowledge.add(store, "A", given, {})
    knowledge.add(store, "B", finding(), {})
    (found,) = knowledge.read(store, "A")
    assert (found.finding, found.superseded) == (given, None)


def test_of_an_older_plant_or_in_the_place_of_another(store: Store) -> None:
    for _ in range(3):
        knowledge.add(store, "A", finding(), {})
    first, second, third = numbers(store)
    knowledge.add(store, "A", finding(1.5), {first: "the plant is another one"}, [third])
    assert numbers(store)[:2] == [first, second] and len(numbers(store)) == 3
    found = knowledge.read(store, "A")
    assert [each.superseded for each in found] == ["the plant is another one", None, None]
    assert found[-1].finding.present.Ms == 1.5


def test_the_latest_ones_of_a_loop_are_kept(store: Store) -> None:
    knowledge.add(store, "B", finding(), {})
    for n in range(knowledge.MAX_OF_A_LOOP + 3):
        knowledge.add(store, "A", finding(last_change_s=float(n)), {})
    kept = [each.finding.last_change_s for each in knowledge.read(store, "A")]
    assert kept == [float(n) for n in range(3, knowledge.MAX_OF_A_LOOP + 3)] and len(numbers(store, "B")) == 1


def test_old_findings_are_deleted_but_what_is_known_stays(store: Store) -> None:
    store.own_loops({"A": {"tag": "A"}})
    for loop in ("A", "gone"):
        for day in (1, 2, 3):
            knowledge.add(store, loop, finding(at=f"2026-01-0{day}T00:00:00.000Z"), {})
    assert knowledge.delete_older(store, "2026-01-02T12:00:00.000Z") == 4
    assert [each.finding.at[:10] for each in knowledge.read(store, "A")] == ["2026-01-03"]
    assert knowledge.delete_older(store, "2027-01-01T00:00:00.000Z") == 0
    assert len(numbers(store, "A")) == len(numbers(store, "gone")) == 1
