"""Checkpoints are whole or not there, and come back on any number of ranks. About 10 s."""

import os
import re
import subprocess
import textwrap

import numpy as np
import pytest
from mpi4py import MPI
from output_cases import cut, run_on, shared_directory, slabs, state

from petfsi.errors import InputError, SolveError
from petfsi.output.checkpoint import find_checkpoint, read_checkpoint, write_checkpoint
from petfsi.output.manifest import read_manifest

comm = MPI.COMM_WORLD


def write(directory, step, keep=3, whole=None, on=comm):
    groups = slabs(whole or state(2), on)
    return write_checkpoint(directory, step, 0.1 * step, 0.1, groups, {"steps": [1, 2], "of": "it"}, on, keep)


def names(directory):
    comm.barrier()
    found = sorted(p.name for p in directory.iterdir())
    comm.barrier()  # before anyone goes on to change what others still look at
    return found


def find(directory):
    """Return the step found and what was said about damaged ones, on all ranks."""
    said = []
    info = find_checkpoint(directory, comm, said.append)
    return (info.step if info else None), comm.bcast(said)


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_state_comes_back_bit_for_bit_in_any_pieces(tmp_path, dim):
    directory, whole = shared_directory(tmp_path, comm), state(dim)
    write(directory, 7, whole=whole)
    info = find_checkpoint(directory, comm, pytest.fail)
    assert (info.step, info.time, info.ranks) == (7, 0.1 * 7, comm.size)
    with read_checkpoint(info, comm) as saved:
        assert (saved.step, saved.time, saved.dt) == (7, 0.1 * 7, 0.1)
        assert saved.attributes == {"steps": [1, 2], "of": "it"}
        assert saved.groups() == ["pressure", "solid"]
        for group, arrays in whole.items():
            read = saved.group(group)
            for name, array in arrays.items():
                for piece in (cut(array, comm, axis=array.ndim - 1), cut(array, MPI.COMM_SELF)):
                    back = read(name, piece.start, piece.data.shape)
                    assert back.dtype == array.dtype
                    assert np.array_equal(back, piece.data)


@pytest.mark.parallel([1, 3])
def test_the_file_does_not_depend_on_ranks_or_on_when_it_is_written(tmp_path):
    directory = shared_directory(tmp_path, comm)
    together = write(directory / "together", 1)
    again = write(directory / "again", 1)
    if comm.rank == 0:
        alone = write(directory / "alone", 1, on=MPI.COMM_SELF)
        assert together.read_bytes() == again.read_bytes() == alone.read_bytes()
    comm.barrier()


@pytest.mark.parallel([1, 3])
def test_the_last_few_are_kept(tmp_path):
    directory = shared_directory(tmp_path, comm)
    for step in (5, 10, 15, 20):
        write(directory, step, keep=2)
    assert names(directory) == ["000015.h5", "000015.json", "000020.h5", "000020.json"]
    write(directory, 25, keep=1)
    assert names(directory) == ["000025.h5", "000025.json"]


def damage_truncate(path):
    os.truncate(path, path.stat().st_size - 1)


def damage_flip(path):
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)


def damage_sidecar(path):
    path.with_suffix(".json").unlink()


def damage_sidecar_text(path):
    path.with_suffix(".json").write_text('{"file": "0000')


def damage_file(path):
    path.unlink()


def damage_format(path):
    sidecar = path.with_suffix(".json")
    sidecar.write_text(read_manifest(sidecar.read_bytes()).model_copy(update={"format": 99}).text())


DAMAGE = {
    damage_truncate: r"bytes and should have",
    damage_flip: r"its checksum does not match",
    damage_sidecar: r"000010\.json is missing; writing it was interrupted",
    damage_sidecar_text: r"000010\.json is not readable",
    damage_file: r"000010\.h5 is missing",
    damage_format: r"000010\.json is of format 99, by petfsi .*; this one reads format 6",
}


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("damage", DAMAGE, ids=lambda f: f.__name__)
def test_a_damaged_newest_is_named_and_the_one_before_it_used(tmp_path, damage):
    directory = shared_directory(tmp_path, comm)
    write(directory, 5)
    path = write(directory, 10)
    if comm.rank == 0:
        damage(path)
    step, said = find(directory)
    assert step == 5
    assert len(said) == 1
    assert str(path) in said[0]
    assert re.search(DAMAGE[damage], said[0]), said[0]


@pytest.mark.parallel([1, 3])
def test_going_back_removes_the_future_that_was_given_up(tmp_path):
    directory = shared_directory(tmp_path, comm)
    for step in (5, 10, 15):
        path = write(directory, step)
    if comm.rank == 0:
        damage_flip(path)
        (directory / "000015.h5.part").write_bytes(b"left by a kill")
        (directory / "000099.h5").write_bytes(b"somebody's own")
        (directory / "000098.json").write_bytes(b"{}")
    assert find(directory)[0] == 10
    write(directory, 12, keep=2)
    others = ["000098.json", "000099.h5"]  # which no manifest of petfsi's explains
    assert names(directory) == ["000010.h5", "000010.json", "000012.h5", "000012.json", *others]


@pytest.mark.parallel([1, 3])
def test_no_checkpoint_is_none(tmp_path):
    directory = shared_directory(tmp_path, comm)
    assert find(directory / "never") == (None, [])
    path = write(directory, 3)
    if comm.rank == 0:
        damage_truncate(path)
    step, said = find(directory)
    assert step is None and len(said) == 1


@pytest.mark.parallel([1, 3])
def test_another_shape_is_an_input_error_on_all_ranks(tmp_path):
    directory = shared_directory(tmp_path, comm)
    write(directory, 1)
    info = find_checkpoint(directory, comm, pytest.fail)

    def restore(*names_and_shapes):
        with read_checkpoint(info, comm) as saved:
            for name, shape in names_and_shapes:
                piece = cut(np.zeros(shape), comm)
                saved.group("pressure")(name, piece.start, piece.data.shape)

    restore(("pressure", (6, 5)))
    for shape in ((6, 4), (7, 5), (3, 5)):
        with pytest.raises(InputError, match=r"'pressure/pressure' has shape \(6, 5\); the scene wants \(\d, \d\)"):
            restore(("pressure", shape))
    with pytest.raises(InputError, match="the scene wants 3 axes"):
        restore(("pressure", (6, 5, 4)))
    with pytest.raises(InputError, match="no array 'pressure/smoke'"):
        restore(("smoke", (6, 5)))
    with pytest.raises(InputError, match="no state of 'beam', only of pressure, solid"):
        with read_checkpoint(info, comm) as saved:
            saved.group("beam")


PREAMBLE = """
from petfsi.output.checkpoint import *
def write(step, n):
    big = {"solid": {"x": cut(np.arange(float(n)), comm)}}
    return write_checkpoint(directory, step, 0.1 * step, 0.1, big, {}, comm, 3)
"""


def run(code, directory, ranks):
    return run_on(ranks, PREAMBLE + textwrap.dedent(code), directory)


@pytest.mark.launches
def test_three_ranks_write_what_two_read(tmp_path):
    done = run('write_checkpoint(directory, 4, 0.4, 0.1, slabs(state(3), comm), {"a": 1}, comm, 1)', tmp_path, 3)
    assert done.returncode == 0, done.stderr
    code = """
    info = find_checkpoint(directory, comm, print)
    assert info.ranks == 3
    with read_checkpoint(info, comm) as saved:
        for group, arrays in state(3).items():
            for name, array in arrays.items():
                piece = cut(array, comm, axis=array.ndim - 1)
                assert np.array_equal(saved.group(group)(name, piece.start, piece.data.shape), piece.data)
    say("same")
    """
    done = run(code, tmp_path, 2)
    assert done.stdout.split() == ["same"] * 2, done.stderr


DISK_FULL = """
first = write(5, 10)
{limit}
try:
    write(10, 1_000_000)
except PetfsiError as error:
    say(f"rank {{comm.rank}} exit {{error.exit_code}}: {{error}}")
comm.barrier()
assert sorted(p.name for p in directory.iterdir()) == ["000005.h5", "000005.json"]
comm.barrier()
{lift}
assert find_checkpoint(directory, comm, print).step == 5
"""


@pytest.mark.parametrize("ranks", [1, 3])
@pytest.mark.parametrize("late", [False, True], ids=["at once", "while writing"])
def test_a_file_that_grows_too_large_ends_in_one_message_on_all_ranks(tmp_path, ranks, late):
    limit = "resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, resource.RLIM_INFINITY))"
    if late:  # the space that was promised is not there after all
        limit = f"fill = hdf5._fill\ndef late(*args):\n    {limit}\n    fill(*args)\nhdf5._fill = late"
        limit += "\nfiles.os.posix_fallocate = lambda *args: None"
    lift = "resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))"
    done = run(DISK_FULL.format(limit=limit, lift=lift), tmp_path, ranks)
    assert done.returncode == 0, done.stderr
    lines = sorted(done.stdout.splitlines())
    assert len(lines) == ranks
    why = "File too large|Input/output error" if late else "File too large"
    for rank, line in enumerate(lines):
        assert re.search(rf"rank {rank} exit 3: step 10, t = 1 s: checkpoint .*/000010.h5 ", line), line
        assert re.search(rf"be written: ({why})\. Last good checkpoint: .*/000005.h5\.$", line), line


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_full_disk_ends_in_one_message_on_all_ranks(tmp_path, ranks):
    if comm.size > 1 or os.geteuid() != 0:
        pytest.skip("mounting a small disk takes root, on one rank")
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", small], capture_output=True).returncode:
        pytest.skip("cannot mount a small disk here")
    try:
        done = run(DISK_FULL.format(limit="", lift=""), small, ranks)
    finally:
        subprocess.run(["umount", small], check=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == ranks
    for line in lines:
        with pytest.raises(
            AssertionError, match=r"No space left on device \(8\.\d+ MB needed, \d\.\d+ MB free\)\. Last"
        ):
            raise AssertionError(line)


@pytest.mark.parallel([1, 3])
def test_a_place_that_cannot_be_written_is_a_solve_error(tmp_path):
    directory = shared_directory(tmp_path, comm)
    if comm.rank == 0:
        (directory / "taken").write_text("a file")
    comm.barrier()
    with pytest.raises(
        SolveError, match=r"taken/000001\.h5 could not be written: File exists\. There is no checkpoint"
    ):
        write(directory / "taken", 1)
