"""Executes an `hq submit` line of the documentation on HyperQueue's server and scheduler.

Usage: hq_submit.py NAMES hq submit --array TASKS [--resource NAME=1] [--wait] -- COMMAND...

PyPI has the server, the worker and the Python interface, but not the program `hq`. A worker of the
Python interface has one indexed pool, its CPUs. It therefore gets one CPU per name in NAMES, separated
by commas, and the index that a task received selects the value of HQ_RESOURCE_VALUES_NAME.

Writes the failed tasks into failed.txt, separated by commas; exits with 1 if there are any.
"""

import sys

from hyperqueue import Job, LocalCluster
from hyperqueue.cluster import WorkerConfig

SELECT = 'names=$1; shift; export "$HQ_POOL=$(echo "$names" | cut -d, -f$((HQ_RESOURCE_VALUES_cpus + 1)))"; exec "$@"'


def parse(words):
    """Returns the tasks, the pool's variable and the command."""
    options, command = words[: words.index("--")], words[words.index("--") + 1 :]
    if options[:2] != ["hq", "submit"]:
        sys.exit(f"expected hq submit, found {options}")
    tasks, pool = [], "HQ_NO_POOL"
    rest = [part for option in options[2:] for part in (option.split("=", 1) if option[:2] == "--" else [option])]
    while rest:
        option = rest.pop(0)
        if option == "--array":
            for part in rest.pop(0).split(","):
                ends = [int(end) for end in part.split("-")]
                tasks += range(ends[0], ends[-1] + 1)
        elif option == "--resource":
            name, amount = rest.pop(0).split("=")
            if amount != "1":
                sys.exit(f"expected one {name} per task, found {amount}")
            pool = f"HQ_RESOURCE_VALUES_{name}"
        elif option != "--wait":
            sys.exit(f"unknown option {option}")
    return tasks, pool, command


def main():
    names, words = sys.argv[1], sys.argv[2:]
    tasks, pool, command = parse(words)
    with LocalCluster() as cluster:
        cluster.start_worker(WorkerConfig(cores=len(names.split(","))))
        client = cluster.client()
        job = Job(max_fails=None)
        for task in tasks:
            # The interface numbers the tasks of each job from 0.
            env = {"HQ_POOL": pool, "TASK": str(task)}
            args = ["sh", "-c", 'export HQ_TASK_ID="$TASK"; ' + SELECT, "sh", names, *command]
            job.program(args, env=env, stdout=f"hq-{task}.out", stderr=f"hq-{task}.err")
        submitted = client.submit(job)
        client.wait_for_jobs([submitted], raise_on_error=False)
        failed = [str(tasks[index]) for index in sorted(client.get_failed_tasks(submitted))]
    with open("failed.txt", "w") as file:
        file.write(",".join(failed))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
