"""Prints the JSON of revisit_server_bench as one table with ratios: medians over
the rounds, ratios taken within a round."""

import json
import statistics
import sys


def median(values):
    return statistics.median(values)


def spread(values):
    return f"{median(values):6.0%} ({min(values):.0%}-{max(values):.0%})"


def rate(value):
    return f"{value / 1e3:9.1f}"


def ingest_table(rounds):
    print("\nDurable poses, thousands a second, beside an empty stream of the "
          "same messages and SQLite\nalone with as many rows a commit; CPU in "
          "microseconds a pose (server + client); acks in ms")
    print(f"{'vehicles':>8}{'a batch':>8}{'revisit':>10}{'empty':>9}"
          f"{'SQLite':>9}{'rows':>6}  {'of empty':20}{'of SQLite':20}"
          f"{'CPU':>12}{'empty':>12}{'ack p50':>9}{'p99':>8}")
    for cases in zip(*(one["ingest"] for one in rounds)):
        def mid(head, key, cases=cases):
            return median([case[head][key] for case in cases])

        def ratio(head, cases=cases):
            return spread([case["revisit"]["poses_per_second"] /
                           case[head]["poses_per_second"] for case in cases])

        def cpu(head):
            return (f"{mid(head, 'server_cpu_us_per_pose'):.2f}+"
                    f"{mid(head, 'client_cpu_us_per_pose'):.2f}")
        print(f"{cases[0]['vehicles']:8}{cases[0]['batch_poses']:8}"
              f"{rate(mid('revisit', 'poses_per_second')):>10}"
              f"{rate(mid('empty', 'poses_per_second'))}"
              f"{rate(mid('sqlite', 'poses_per_second'))}"
              f"{mid('sqlite', 'rows_a_commit'):6.0f}  "
              f"{ratio('empty'):20}{ratio('sqlite'):20}"
              f"{cpu('revisit'):>12}{cpu('empty'):>12}"
              f"{mid('revisit', 'p50_ms'):9.2f}{mid('revisit', 'p99_ms'):8.2f}")


def metrics_table(rounds):
    print("\n8 streams in turn beside scrapes of /metrics, one a second, and without: "
          "CPU of the\nserver in microseconds a pose, and what scraped slices take and "
          "carry of the others")
    print(f"{'a batch':>8}{'alone':>9}{'scraped':>9}  {'CPU':20}{'poses':20}"
          f"{'page':>7}")
    for cases in zip(*(one["metrics"] for one in rounds)):
        def mean(case, head, key):
            return statistics.fmean(part[key] for part in case[head])

        def ratio(key, cases=cases):
            return spread([mean(case, "scraped", key) / mean(case, "alone", key)
                           for case in cases])

        cpu = "server_cpu_us_per_pose"
        print(f"{cases[0]['batch_poses']:8}"
              f"{median([mean(case, 'alone', cpu) for case in cases]):9.3f}"
              f"{median([mean(case, 'scraped', cpu) for case in cases]):9.3f}"
              f"  {ratio(cpu):20}{ratio('poses_per_second'):20}"
              f"{cases[0]['scraped'][0]['page_bytes']:7}")


def query_table(rounds):
    queries = [one["query"] for one in rounds]
    print(f"\nUnary calls, ms; searches on a vehicle of {queries[0]['nodes']} "
          "nodes. Loaded: while 4 other vehicles stream\nbatches of 64, one "
          "at a time each")
    print(f"{'':36}{'p50':>9}{'p99':>9}{'loaded p50':>12}{'p99':>9}")
    rows = [("empty", "an empty server"), ("info", "GetServerInfo"),
            ("find", "FindCandidates")]
    for head, label in rows:
        line = f"{label:36}"
        for name in (head, head + "_loaded"):
            width = 12 if name.endswith("loaded") else 9
            line += f"{median([q[name]['p50_ms'] for q in queries]):{width}.3f}"
            line += f"{median([q[name]['p99_ms'] for q in queries]):9.3f}"
        print(line)
    for name in ("find", "find_loaded"):
        search = median([q[name]["search_p50_ms"] for q in queries])
        whole = median([q[name]["p50_ms"] for q in queries])
        # Under load, against a call that waits for the same processors.
        base, words = (("info_loaded", "GetServerInfo under the same load")
                       if "loaded" in name else ("empty", "an empty call"))
        empty = median([q[base]["p50_ms"] for q in queries])
        print(f"  {search:.3f} of it is the search; it adds "
              f"{whole - empty:.3f} to {words}, all around the search "
              f"{whole - empty - search:.3f}")


def stall_table(rounds):
    stalls = [one["stall"] for one in rounds]
    print(f"\nAcknowledgements of 4 vehicles, ms, while callers search another "
          f"one of {stalls[0]['nodes']} nodes one search after the other")
    print(f"{'callers':>8}{'ack p50':>9}{'p99':>9}{'search p50':>12}")
    for entries in zip(*(stall["acks"] for stall in stalls)):
        print(f"{entries[0]['callers']:8}"
              f"{median([e['p50_ms'] for e in entries]):9.2f}"
              f"{median([e['p99_ms'] for e in entries]):9.2f}"
              f"{median([e['search_p50_ms'] for e in entries]):12.1f}")


WATCH_CASES = (("alone", "nobody"), ("unwanted", "all, let nothing pass"),
               ("own", "one vehicle each"))


def watch_table(rounds):
    watches = [one["watch"] for one in rounds]
    first = watches[0]
    cases = [case for case in WATCH_CASES if case[0] in first]
    print(f"\nAcknowledgements of {first['streams']} vehicles with stored checks, ms, "
          f"at {first['wanted_poses_per_second']:g} poses a second\ntogether, beside "
          f"{first['watchers']} watches; KiB of the server a watch once all have "
          "begun, and MiB beyond\nthose of nobody once all is told; checks owed after "
          "the load, and seconds until none is;\nprocessor of the server for each "
          "check, all else that it does included, ms; processor seconds\nof the feed's "
          "thread, and its share of a core during the load")
    print(f"{'watched':22}{'ack p50':>8}  {'of nobody':20}{'p99':>8}  {'of nobody':20}"
          f"{'KiB':>7}{'MiB':>7}{'owed':>7}{'s':>6}{'check':>7}{'feed':>6}{'share':>7}"
          f"{'told':>8}")
    for name, label in cases:
        def mid(key, name=name):
            return median([watch[name][key] for watch in watches])

        def ratio(key, name=name):
            return spread([watch[name][key] / watch["alone"][key]
                           for watch in watches])

        def beyond(key, name=name):
            return median([watch[name][key] - watch["alone"][key]
                           for watch in watches])

        begun = median([watch[name]["resident_watched_bytes"] -
                        watch[name]["resident_bytes"] for watch in watches]) / 1024
        memory = (f"{'':14}" if name == "alone" else
                  f"{begun / first['watchers']:7.1f}"
                  f"{beyond('resident_told_bytes') / 2**20:7.1f}")
        print(f"{label:22}{mid('p50_ms'):8.2f}  {ratio('p50_ms'):20}"
              f"{mid('p99_ms'):8.2f}  {ratio('p99_ms'):20}{memory}"
              f"{mid('check_debt'):7.0f}{mid('debt_seconds'):6.1f}"
              f"{1e3 * mid('server_cpu_seconds') / mid('checks'):7.2f}"
              f"{mid('feed_cpu_seconds'):6.2f}{mid('feed_cpu_share'):7.1%}"
              f"{mid('told'):8.0f}")
    print("By rounds, p50 and p99:")
    for number, watch in enumerate(watches, 1):
        print(f"  {number}: " + "; ".join(
            f"{label} {watch[name]['p50_ms']:.2f}, {watch[name]['p99_ms']:.2f}"
            for name, label in cases))


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        result = json.load(file)
    rounds = result["rounds"]
    print(f"The server over loopback: medians of {len(rounds)} rounds, "
          f"{result['seconds']:g} s each measurement; load of the machine "
          f"{result['load']:.1f}")
    for part, table in (("ingest", ingest_table), ("metrics", metrics_table),
                        ("query", query_table), ("stall", stall_table),
                        ("watch", watch_table)):
        if all(part in one for one in rounds):
            table(rounds)


if __name__ == "__main__":
    main()
