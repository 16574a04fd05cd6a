"""The package has only a launch file, and runs the program `sgc` of the host."""
