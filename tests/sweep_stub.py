"""In the place of petfsi, for tests of sweeps: does in milliseconds what a run's name says, and leaves what it does.

A name says: fails, killed (the first time), dies (always), refused, full, slow; else five steps are taken.
"""

import fcntl
import json
import os
import signal
import sys
import time
from pathlib import Path

told = []
signal.signal(signal.SIGUSR1, lambda *_: told.append(1))
command, *words = sys.argv[1:]
out = Path(words[words.index("--out") + 1] if command == "run" else words[0])
name, root = out.name, out.parents[1]
with open(root / "starts.txt", "a") as file:
    file.write(f"{name} {command}\n")


def summary(status, step, reason="", **more):
    text = json.dumps(
        {"status": status, "steps": step, "reason": reason, "wall_s": 0.1, "probes": {"top": 0.5}, **more}
    )
    (out / "summary.json.part").write_text(text)
    os.replace(out / "summary.json.part", out / "summary.json")


def fail(kind, step, code):
    summary("failed", step, f"it {kind}", failure={"kind": kind, "step": step + 1})
    sys.exit(code)


if "refused" in name:
    print("petfsi: scene.toml: one mistake\n  time.dt: no")
    sys.exit(2)
if "dies" in name:
    os.kill(os.getpid(), signal.SIGKILL)
assert command == "resume" or "--overwrite" in words or not (out / ".petfsi-run").exists()
(out / ".petfsi-run").write_text("{}")
(out / "checkpoint").mkdir(exist_ok=True)
guard = open(out / "one", "w")
fcntl.flock(guard, fcntl.LOCK_EX | fcntl.LOCK_NB)  # two at once would be an error, seen as a defect
step = max((int(path.stem) for path in (out / "checkpoint").glob("*.json")), default=0)
summary("running", step)
while step < 5:
    if told:
        summary("stopped", step, "SIGUSR1")
        sys.exit(75)
    step += 1
    time.sleep(0.15 if "slow" in name else 0)
    (out / "checkpoint" / f"{step:06d}.json").write_text("{}")
    if "fails" in name and step == 3:
        fail("diverged", step, 3)
    if "full" in name and step == 3 and not (root / "room").exists():
        fail("disk", step, 3)
    if "killed" in name and command == "run" and step == 2:
        os.kill(os.getpid(), signal.SIGKILL)
summary("done", step)
