"""The gateway of `benchmarks.rehearsed` as a process:

    python -m benchmarks.rehearsed_gateway FOLDER HOST LOOPS AT_ONCE PACE DATABASE

Each process of a computation imports the main module of its service anew (multiprocessing), which takes seconds where
that is a module of the service. This one imports nothing then, as the script `loopwright` imports nothing that the fork
server has not loaded.
"""

if __name__ == "__main__":
    from benchmarks.rehearsed import main

    main()
