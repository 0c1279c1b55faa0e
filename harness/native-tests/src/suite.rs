//! Builds the test program of a folder of scenarios and a rig.

use crate::error::SuiteError;
use crate::play::TestContext;
use libtest_mimic::{Arguments, Trial};
use platebench_model::scenario::{Scenario, find};
use platebench_rig::RigSpec;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

/// Environment variable that replaces the rig of the suite, for example by a board.
pub const RIG_VARIABLE: &str = "PLATEBENCH_RIG";

#[derive(Debug, Clone)]
pub struct Suite {
    scenarios: PathBuf,
    out: PathBuf,
    rig: String,
}

impl Suite {
    /// `scenarios` is a folder or one file. Run folders are created below `out`. Relative paths
    /// start in the folder of the package, as in every Cargo test.
    pub fn new(scenarios: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self { scenarios: scenarios.into(), out: out.into(), rig: "emulated".to_owned() }
    }

    /// Sets the rig, as `platebench run --rig` (default `emulated`). [`RIG_VARIABLE`] overrides it.
    #[must_use]
    pub fn rig(mut self, rig: impl Into<String>) -> Self {
        self.rig = rig.into();
        self
    }

    /// Exit codes: 0 all tests passed, 101 a test failed, 2 invalid scenario or rig, 4 no scenario.
    pub fn run(mut self) -> ExitCode {
        if let Ok(rig) = std::env::var(RIG_VARIABLE) {
            self.rig = rig;
        }
        let mut arguments = Arguments::from_args();
        match self.tests() {
            Ok(tests) => {
                if tests.one_at_a_time {
                    arguments.test_threads = Some(1);
                }
                libtest_mimic::run(&arguments, tests.trials).exit_code()
            }
            Err(error) => {
                // Diagnostics of scenarios have their own prefix.
                let prefix = if matches!(error, SuiteError::Scenarios(_)) { "" } else { "error: " };
                eprintln!("{prefix}{error}");
                ExitCode::from(error.exit_code())
            }
        }
    }

    fn tests(&self) -> Result<SuiteTests, SuiteError> {
        let rig: RigSpec = self.rig.parse().map_err(SuiteError::Rig)?;
        rig.check().map_err(SuiteError::Connect)?;
        let found = find(std::slice::from_ref(&self.scenarios)).map_err(SuiteError::Scenarios)?;
        if found.scenarios.is_empty() && found.skipped.is_empty() {
            return Err(SuiteError::NoScenarios(self.scenarios.clone()));
        }
        let one_at_a_time = !rig.allows_parallel_links();
        let context = Arc::new(TestContext::new(rig, self.out.clone()));
        let judged = found.scenarios.into_iter().map(|scenario| (scenario, false));
        let mut scenarios: Vec<_> = judged.chain(found.skipped.into_iter().map(|scenario| (scenario, true))).collect();
        scenarios.sort_by(|(a, _), (b, _)| a.file.cmp(&b.file));
        let test = |(scenario, ignored): (Scenario, bool)| {
            let context = Arc::clone(&context);
            let name = scenario.name().to_owned();
            Trial::test(name, move || context.run_scenario(scenario).map_err(Into::into)).with_ignored_flag(ignored)
        };
        let trials = scenarios.into_iter().map(test).collect();
        Ok(SuiteTests { trials, one_at_a_time })
    }
}

struct SuiteTests {
    trials: Vec<Trial>,
    /// True if all tests need the same line, so that they cannot run in parallel.
    one_at_a_time: bool,
}
