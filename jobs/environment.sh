# One thread per rank, and HDF5 with MPI even on one rank; Open MPI refuses root unless told otherwise.
export OMP_NUM_THREADS=1 H5PY_ALWAYS_USE_MPI=1
if [ "$(id -u)" = 0 ]; then
    export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fi
# mpirun that is told to end (Ctrl-C, SIGTERM, SIGHUP) tells its ranks after so many seconds and kills them after twice
# as many; by default after one and two, which is too soon for a step that takes longer to end in a checkpoint. It waits
# as long after any exit code but 0, too: a person at a terminal has better things to do.
if [ ! -t 1 ]; then
    export OMPI_MCA_odls_base_sigkill_timeout="${OMPI_MCA_odls_base_sigkill_timeout:-10}"
fi
