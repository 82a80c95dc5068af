"""What the benches in Python share: whole processes measured, and medians with their interval."""
import datetime
import os
import subprocess


def run(command: list) -> tuple:
    """CPU seconds (user + system, all threads) and wall seconds of a whole process, and what it printed."""
    start = datetime.datetime.now()
    child = subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    text, error = child.stdout.read(), child.stderr.read()
    _, status, usage = os.wait4(child.pid, 0)
    wall = (datetime.datetime.now() - start).total_seconds()
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{error.decode()}")
    return usage.ru_utime + usage.ru_stime, wall, text.decode()


def figure(rows: int, columns: int, size: tuple) -> tuple:
    """A figure to be written as a file, and its axes by row and column."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=size, squeeze=False)


def save(drawn, path) -> None:
    drawn.tight_layout()
    drawn.savefig(path)
    print(f"plots in {path}")


def interval(ratios: list) -> tuple:
    """Order statistics that hold the median with at least 95 % (binomial)."""
    r = sorted(ratios)
    n = len(r)
    tail, k, p = 0.0, 0, 0.5 ** n
    while k < n // 2 and tail + p <= 0.025:
        tail += p
        k += 1
        p = p * (n - k + 1) / k
    return r[max(k - 1, 0)], r[min(n - k, n - 1)]
