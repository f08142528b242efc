"""The lab holds what the benchmarks share: options, tasks, methods, jobs, rows and pictures."""
