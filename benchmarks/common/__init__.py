"""What several benchmarks share: reports, scenes with their truth, figures, and the worlds of single benchmarks."""
