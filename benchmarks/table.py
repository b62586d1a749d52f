"""The table of `make bench`: the rows of each benchmark, of the figures that it prints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Figures = dict[str, Any]

HEAD = ["| what | figure | goal | |", "| --- | --- | --- | --- |"]


def row(what: str, figure: str, goal: str = "", met: bool | None = None) -> str:
    return f"| {what} | {figure} | {goal} | {'' if met is None else 'met' if met else '**missed**'} |"


def of_bus(bus: Figures) -> list[str]:
    timed, speed = bus["real_time_100_loops"], bus["speed_factor"]

    def ratio(name: str) -> str:
        low, high = bus[f"{name}_ratio_range"]
        return f"{bus[f'{name}_per_s']:,.0f}/s, {bus[f'{name}_ratio']:.2f} of bare ({low:.2f} to {high:.2f})"

    return [
        row("bare AF_CAN + struct, the same three frames", f"{bus['bare_per_s']:,.0f} samples/s"),
        row("plant and controller devices, nobody listening", ratio("devices"), "0.5", bus["devices_ratio"] >= 0.5),
        row("the same, a tuner takes every sample", ratio("listening"), "0.33", bus["listening_ratio"] >= 1 / 3),
        row(
            "the same, the live loop of a retune (plant in blocks)",
            f"{bus['live_loop_per_s']:,.0f}/s, {bus['live_loop_ratio']:.2f} of bare",
        ),
        row(
            f"times real time at Ts = 0.1 s with {'/'.join(speed)} loops",
            "/".join(f"{each:.3g}" for each in speed.values()),
        ),
        row(
            f"100 loops in real time, Ts = 0.1 s, {timed['samples']} samples: last MV late by",
            f"{timed['late_median_ms']:.1f} ms (median), {timed['late_max_ms']:.1f} ms (worst), "
            f"{timed['late_by_more_than_half_Ts']} samples by more than Ts/2",
            "none by more than 50 ms",
            timed["late_by_more_than_half_Ts"] == 0,
        ),
        row(
            "the same, SYNC to last MV",
            f"{timed['sync_to_last_mv_median_ms']:.1f} ms (median), {timed['sync_to_last_mv_max_ms']:.1f} ms (worst)",
        ),
    ]


def of_load(load: Figures) -> list[str]:
    many = load["retunes"][-1]
    return [
        *(
            row(
                f"{each['loops']} loops of one node retuned by {each['method']} at the same time, Ts = 0.1 s, plant at "
                f"{each['pace']:g} times real time",
                f"{each['proposed']} of {each['loops']} proposed in {each['wall_s']:.0f} s, "
                f"{each['of_plant_time']:.2f} times the plant's {each['longest_plant_s'] / each['pace']:.0f} s",
                "all, 1.3 times",
                each["proposed"] == each["loops"] and each["of_plant_time"] <= 1.3,
            )
            for each in (many, load["fast"])
        ),
        row(
            "the same: what the processor lets the bus do, devices alone / with as many bare listeners",
            f"{load['devices_alone']:.1f} / {load['listeners']:.1f} times real time",
        ),
        row(
            f"the same: memory of the service with {'/'.join(str(each['loops']) for each in load['retunes'])} loops",
            f"{'/'.join(format(each['memory_MB'], '.0f') for each in load['retunes'])} MB, "
            f"{load['MB_per_loop']:.2f} MB for a loop more",
            "under 5 MB",
            load["MB_per_loop"] < 5.0,
        ),
    ]


def of_rehearsal(rehearsal: Figures) -> list[str]:
    return [
        row(
            f"rehearsal, {rehearsal['proposed']:.0f} of {rehearsal['models']} models proposed, Ts = 0.1 s",
            f"{rehearsal['factor']:,.0f} times plant time "
            f"({rehearsal['plant_s']:,.0f} s in {rehearsal['wall_s']:.1f} s)",
            "2,000",
            rehearsal["factor"] >= 2000,
        ),
        row("the same, peak memory", f"{rehearsal['peak_MB']:.0f} MB", "under 300 MB", rehearsal["peak_MB"] < 300),
    ]


def of_criterion(criterion: Figures) -> list[str]:
    return [
        row(
            "criterion (7), one loop, against python-control + scipy",
            f"{criterion['ratio']:.0f} times faster ({1e3 * criterion['ours_s']:.1f} ms, {criterion['plain_s']:.2f} s)",
            "20",
            criterion["ratio"] >= 20,
        ),
        row(
            "the same, J of both results by our criterion",
            f"{criterion['J_of_ours']:.3f} against {criterion['J_of_plain']:.3f}",
            "the same or lower",
            criterion["J_of_ours"] <= criterion["J_of_plain"],
        ),
    ]


def of_response(response: Figures) -> list[str]:
    return [
        row(
            "step figures, 10,000 samples, 500 to the dead time, against python-control with a 5th-order Pade",
            f"{response['ratio']:.0f} times faster ({1e3 * response['ours_s']:.1f} ms, "
            f"{1e3 * response['plain_s']:.0f} ms)",
            "20",
            response["ratio"] >= 20,
        ),
        row(
            "the same, worst error of PV for a unit step against the closed form",
            f"{response['ours_y_error']:.1e} against {response['plain_y_error']:.1e}",
            "the same or lower",
            response["ours_y_error"] <= response["plain_y_error"],
        ),
    ]


def of_me_pso(me_pso: Figures) -> list[str]:
    return [
        row(
            f"ME-PSO, no dead time, {me_pso['no_dead_time_evaluations']:,.0f} step responses",
            f"{me_pso['no_dead_time_s']:.2f} s",
            "2 s",
            me_pso["no_dead_time_s"] <= 2.0,
        ),
        row(
            f"ME-PSO, dead time, {me_pso['dead_time_evaluations']:,.0f} step responses",
            f"{me_pso['dead_time_s']:.2f} s",
            "5 s",
            me_pso["dead_time_s"] <= 5.0,
        ),
    ]


def of_tune(tune: Figures) -> list[str]:
    return [
        row(
            f"loopwright tune --method all, start to exit, slowest of {tune['models']} models ({tune['slowest']})",
            f"{tune['wall_s']:.2f} s",
            "2 s",
            tune["wall_s"] <= 2.0,
        ),
        row("the same, peak memory", f"{tune['peak_MB']:.0f} MB", "under 200 MB", tune["peak_MB"] < 200),
    ]


def of_engine(engine: Figures) -> list[str]:
    return [
        row(
            "a job that does nothing, from asking to its written end, 60 at once, SQLite",
            f"{engine['job_ms']:.1f} ms, of which {engine['job_ask_ms']:.1f} ms to ask",
        ),
        row(
            "a stage's two events, written (SQLite, synced); what the loop's own thread waits of it",
            f"{engine['stage_written_ms']:.1f} ms, {engine['stage_of_shortest_pct']:.2f} % of the shortest stage, 5 s; "
            f"{engine['stage_told_ms']:.2f} ms",
            "under 1 %",
            engine["stage_of_shortest_pct"] < 1.0,
        ),
    ]


def of_gateways(gateways: Figures) -> list[str]:
    def rates(of: Figures) -> str:
        return "/".join(f"{each['per_min']:.0f}" for each in of.values())

    def growth(of: Figures) -> float:
        return float(of[max(of, key=int)]["per_min"] / of["1"]["per_min"])

    def busy(of: Figures) -> str:
        return "/".join(f"{each['busy']:.1f}" for each in of.values())

    return [
        row(
            f"{gateways['loops']:,} rehearsed loops on one PostgreSQL, {'/'.join(gateways['paced'])} gateways, "
            f"{gateways['at_once']} jobs at once each, plants at {gateways['pace']:g} times real time",
            f"{rates(gateways['paced'])} jobs per minute, {growth(gateways['paced']):.2f} times as many with "
            f"{max(gateways['paced'], key=int)} gateways as with 1",
        ),
        row(
            f"the same, {gateways['unpaced_at_once']} jobs at once each, plants as fast as {gateways['processors']} "
            "processors go",
            f"{rates(gateways['unpaced'])} jobs per minute, {busy(gateways['unpaced'])} processors busy, "
            f"{1e3 * gateways['unpaced']['1']['processor_s']:.0f} ms of processor for a job",
        ),
    ]


def of_answers(answers: Figures) -> list[str]:
    return [
        row(
            f"GET /jobs/ID, {answers['rate_per_s']}/s, while {answers['loops']} loops are retuned, "
            f"p95 of {answers['rounds']} rounds",
            f"{answers['busy_p95_ms']:.1f} ms, idle {answers['idle_p95_ms']:.1f} ms: {answers['ratio']:.1f} times "
            f"({answers['ratio_range'][0]:.1f} to {answers['ratio_range'][1]:.1f})",
            "3 times",
            answers["ratio"] <= 3.0,
        ),
        row(
            f"the same service with {'/'.join(answers['memory_MB'])} loops under test; all aborted and restored",
            f"{'/'.join(format(each, '.0f') for each in answers['memory_MB'].values())} MB, "
            f"{answers['MB_per_loop']:.2f} MB for a loop more; {answers['abort_all_s']:.1f} s",
            "under 5 MB",
            answers["MB_per_loop"] < 5.0,
        ),
    ]


def of_fast(fast: Figures) -> list[str]:
    return [
        row(
            f"fast: identification, design and verdict of one record of {fast['samples']} samples",
            f"{fast['ours_s']:.2f} s of processor (median)",
            "1 s",
            fast["ours_s"] <= 1.0,
        ),
        row(
            "the same, against least_squares on responses simulated step by step",
            f"{fast['ratio']:.0f} times faster ({fast['plain_s']:.1f} s, Ms {fast['ours_Ms']:.3f} against "
            f"{fast['plain_Ms']:.3f}, asked 1.6)",
            "10",
            fast["ratio"] >= 10.0,
        ),
        row(
            f"the same, {fast['records']} records in a row",
            f"{fast['each_s']:.2f} s of processor each, memory grown by {fast['grown_MB']:.1f} MB",
            "1.5 s",
            fast["each_s"] <= 1.5,
        ),
    ]


def of_listening(listening: Figures) -> list[str]:
    hub, many, memory = listening["hub"], listening["many"], listening["memory"]
    return [
        row(
            f"listening to {hub['loops']} loops on a hub, {hub['samples_per_s']:,.0f} samples/s",
            f"{100 * hub['share_of_a_core']:.1f} % of a core",
            "25 %",
            hub["share_of_a_core"] < 0.25,
        ),
        row(
            f"listening to {many['loops']:,} loops on ten buses in memory, {many['samples_per_s']:,.0f} samples/s",
            f"{100 * many['share_of_a_core']:.0f} % of a core, {many['us_per_sample']:.1f} us a sample",
        ),
        row(
            f"history of a loop with {memory['hours']:g} h at ten samples/s",
            f"{memory['bytes_per_loop']:,} bytes, {memory['answer_ms']:.1f} ms to answer for all of it",
            "1 MB",
            memory["bytes_per_loop"] < 1_000_000,
        ),
    ]


def of_page(page: Figures) -> list[str]:
    visits, frames, updates, hour = page["visits"], page["frames"], page["updates"], page["hour"]
    viewers = page["viewers"]
    beats = viewers["heartbeat"]

    def counted(name: str) -> str:
        of = frames[name]
        return (
            f"{of['late']} of {of['frames']:,}, worst {of['worst_ms']:.0f} ms; an empty page in turn with it "
            f"{of['empty_late']} of {of['empty_frames']:,}, {of['empty_worst_ms']:.0f} ms; "
            f"{100 * of['share_of_a_core']:.1f} % of a core"
        )

    def grown(name: str) -> str:
        of = hour[name]
        heap = "/".join(f"{each / 1e6:.2f}" for each in of["heap_bytes"])
        return (
            f"{heap} MB, nodes {'/'.join(map(str, of['nodes']))}, listeners {'/'.join(map(str, of['listeners']))}, "
            f"in {of['took_s']:.0f} s"
        )

    def flat(name: str) -> bool:
        of = hour[name]
        same = all(of[each][0] >= of[each][-1] for each in ("nodes", "listeners"))
        return same and of["heap_bytes"][-1] - of["heap_bytes"][0] < 1e6

    return [
        row(
            f"first visit of the page, {visits['loops']} loops, all that is sent",
            f"{visits['bytes'] / 1e3:.0f} kB, {visits['requests']} requests",
            "300 kB",
            visits["bytes"] < 300_000,
        ),
        row(
            "the same, from the navigation to the rows on the screen; the second visit",
            f"{visits['rows_ms'] / 1e3:.2f} s (median), {visits['rows_worst_ms'] / 1e3:.2f} s (worst); "
            f"{visits['rows_again_ms'] / 1e3:.2f} s",
            "1 s",
            visits["rows_ms"] < 1000.0,
        ),
        *(
            row(
                f"{what}, {frames['loops']} loops at 10 Hz: frames over 50 ms",
                counted(name),
                "none more than on the empty page",
                frames[name]["late"] <= frames[name]["empty_late"],
            )
            for name, what in (("overview", "overview"), ("loop", "a loop's page with its trend"))
        ),
        row(
            f"overview with {updates['loops']} loops, one update a second: script of a second",
            f"{updates['script_ms']:.0f} ms (median), {updates['script_worst_ms']:.0f} ms (worst, with sparklines); "
            f"layout and styles {updates['layout_ms']:.0f} and {updates['layout_worst_ms']:.0f} ms",
            "100 ms",
            updates["script_worst_ms"] < 100.0,
        ),
        *(
            row(
                f"{what}: heap after collection at the beginning, in the middle and at the end of an hour",
                grown(name),
                "under 1 MB more",
                flat(name),
            )
            for name, what in (("overview", "overview"), ("loop", "a loop's page with its trend"))
        ),
        row(
            f"GET /jobs/ID, {viewers['rate_per_s']:g}/s, beside {viewers['viewers']} viewers of the overview, "
            f"p95 of {viewers['rounds']} rounds",
            f"{viewers['viewed_p95_ms']:.1f} ms, without them {viewers['alone_p95_ms']:.1f} ms: "
            f"{viewers['ratio']:.1f} times ({viewers['ratio_range'][0]:.1f} to {viewers['ratio_range'][1]:.1f})",
            "2 times",
            viewers["ratio"] <= 2.0,
        ),
        row(
            "the same: the heartbeat of the test that runs comes late by, with and without them",
            f"{beats['viewed']['p95_ms']:.1f} and {beats['alone']['p95_ms']:.1f} ms (p95), "
            f"{beats['viewed']['worst_ms']:.0f} and {beats['alone']['worst_ms']:.0f} ms (worst)",
        ),
    ]


def of_preview(found: Figures) -> list[str]:
    return [
        row(
            f"preview with a model, {found['plants']} plants, {found['runs']} undisturbed retunes: PV beyond the bound",
            f"{found['beyond']} runs, by {100 * found['most_beyond']:.0f} % of it at most",
            "5 % of the runs, by 10 %",
            found["beyond"] <= 0.05 * found["runs"] and found["most_beyond"] <= 0.1,
        ),
        row(
            "the same, the bound over how far PV went",
            f"{found['times_median']:.2f} (median), {found['times_p90']:.2f} (p90)",
            "1.5 times at the median",
            found["times_median"] <= 1.5,
        ),
    ]


ROWS: dict[str, Callable[[Figures], list[str]]] = {
    "bus": of_bus,
    "load": of_load,
    "rehearsal": of_rehearsal,
    "criterion": of_criterion,
    "response": of_response,
    "me_pso": of_me_pso,
    "tune": of_tune,
    "engine": of_engine,
    "gateways": of_gateways,
    "answers": of_answers,
    "listening": of_listening,
    "fast": of_fast,
    "page": of_page,
    "preview": of_preview,
}
