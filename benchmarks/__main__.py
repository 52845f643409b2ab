"""`make bench`: every benchmark in turn."""

import sys

from benchmarks import batch, charts, filters, maximum_likelihood, regression, score

if __name__ == "__main__":
    sys.stdout.write(f"Maximum likelihood, sample campaign\n{maximum_likelihood.run()}\n")
    sys.stdout.write(f"Score test against refit, sample campaign\n{score.run()}\n")
    sys.stdout.write(f"Regression of a calibration, with all its tests\n{regression.run()}\n")
    sys.stdout.write(f"Reduction of one run of a batch against reading it\n{batch.run()}\n")
    sys.stdout.write(f"Charts of 10^6 points in a browser, beside plotly\n{charts.run()}\n")
    sys.stdout.write(f"Loads in time: filters, smoothers, and the whole reduction\n{filters.run()}\n")
