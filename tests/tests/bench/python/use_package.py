"""Uses the package as a person would, with both libraries of frames."""

import platebench

run = platebench.run("scenarios/good.toml", rig="hosted", trials=2, out="first")
assert run.verdict == "pass", run
assert list(run.scenarios.file) == ["good.toml"]
assert list(run.expectations.metric) == ["settling_time_ms"]
assert list(run.trials["index"]) == [0, 1]
assert run.trace("good.toml", 1).t_s.is_monotonic_increasing

failed = platebench.run("scenarios/bad.toml", rig="hosted")
assert failed.verdict == "fail", failed

other = platebench.Run("first", frames="polars")
assert other.trace()["amplitude_um"].to_list() == run.trace().amplitude_um.to_list()
assert other.expectations["value"].to_list() == run.expectations.value.to_list()

try:
    platebench.run("absent.toml", rig="hosted", out="wrong")
except platebench.PlatebenchError as error:
    assert error.exit_code == 2 and "absent.toml" in str(error), error
else:
    raise AssertionError("absent.toml")
for scenario, trial in (("other", 0), ("good", 9)):
    try:
        run.trace(scenario, trial)
    except KeyError:
        pass
    else:
        raise AssertionError(scenario)
print("pandas and polars agree")
