"""The figures of the paper, drawn from computations of our own."""
