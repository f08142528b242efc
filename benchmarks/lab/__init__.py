"""The lab holds what the benchmarks share, in rooms of which each imports those before it alone.

- io: files of results, versions and devices, worker processes, ``torchrun`` and Ray.
- demonstrations: the tasks, and the sources of their demonstrations: official files, experts, images.
- methods: the methods that ``--prior`` names.
- options: a dataclass per concern, presets, the command line of a script, the options of earlier runs.
- measures: memory gain, errors of sources, straightness of flows, the toy, speed, and intervals.
- reporting: rows, the meaning of every column, tables, charts, model cards, and the paper's numbers.
- running: a policy and its folder; the jobs that train, measure, play and film it; agents in source space.
"""
