"""usage: private_postgres.py BIN DIRECTORY: starts a PostgreSQL with the tables of
revisit and its files in the directory, prints the URL by which servers reach it, and
stops it at the end of the standard input. Exit code 77 without PostgreSQL."""

import importlib
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "deploy/cluster")]
private_cluster = importlib.import_module("private_cluster")
SKIPPED = 77


def main(binaries, directory):
    if private_cluster.find_postgres() is None:
        return SKIPPED
    with private_cluster.Processes(pathlib.Path(directory)) as processes:
        postgres = private_cluster.Postgres(processes)
        subprocess.run(
            [f"{binaries}/revisitd", "migrate", "--store",
             postgres.url("revisit_owner")], check=True, stdout=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL)
        print(postgres.url("revisit"), flush=True)
        sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
