"""What the benchmarks share: options, tasks and their demonstrations, methods, jobs, rows and pictures."""
