"""The lab holds what the benchmarks share: options, tasks, methods, jobs, rows and pictures.

- options, presets: the options, a dataclass per concern, and where they start.
- command_line, stored_options: what a script reads, its folder, and the options of runs before it.
- tasks: the tasks, and where their demonstrations come from.
- scripted, downloads, render: scripted experts, official files, images from simulator states.
- methods, learned_sources, bridge, mip: the methods that ``--prior`` names.
- comparison: which jobs a comparison needs, and in which order.
- policies: a policy and its folder; the jobs that train and play it; rows.
- measures, source_errors: the job that measures a policy: leak, memory gain, curvature.
- jobs, workers, leader, ray_cluster: worker processes, ``torchrun``, or Ray.
- report, columns, statistics: tables, the meaning of every column, intervals.
- plots, pictures, paper: figures, and the paper's numbers.
- navigation: the toy. agents, ray_collection: agents in source space.
- files, machine, timing: files of rows, versions and devices, a clock.
"""
