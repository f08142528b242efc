"""The lab holds what the benchmarks share: options, tasks, methods, jobs, rows and pictures.

- options, presets: the options, a dataclass per concern, and the presets that they start from.
- command_line, stored_options: the command line and output folder of a script, the options of earlier runs.
- tasks: the tasks, and the sources of their demonstrations.
- scripted, downloads, render: scripted experts, official files, images from simulator states.
- methods, learned_sources, bridge, mip: the methods that ``--prior`` names.
- comparison: the jobs of a comparison, and their order.
- policies: a policy and its folder; the jobs that train and play it; rows.
- measures, source_errors: the job that measures a policy: leak, memory gain, curvature.
- jobs, workers, leader, ray_cluster: worker processes, ``torchrun``, or Ray.
- report, columns, statistics: tables, the meaning of every column, intervals.
- plots, pictures, paper: figures, and the paper's numbers.
- navigation: the toy.
- agents, ray_collection: agents in source space.
- files, machine, timing: files of rows, versions and devices, a clock.
"""
