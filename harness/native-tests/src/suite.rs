//! What is played to what, and the test program that comes of it.

use crate::error::SuiteError;
use crate::play::TestContext;
use libtest_mimic::{Arguments, Trial};
use platebench_rig::RigSpec;
use platebench_scenario::{Diagnostic, Scenario, find};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

/// The environment variable that names another rig than the suite's own: the same tests on a board.
pub const RIG_VARIABLE: &str = "PLATEBENCH_RIG";

/// A folder of scenarios and the rig that they are played to.
#[derive(Debug, Clone)]
pub struct Suite {
    scenarios: PathBuf,
    out: PathBuf,
    rig: String,
}

impl Suite {
    /// The scenarios in `scenarios` and below it, or one file, with a run folder for each of them below `out`. Relative paths start where Cargo starts tests: in
    /// the folder of the package.
    pub fn new(scenarios: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self { scenarios: scenarios.into(), out: out.into(), rig: "emulated".to_owned() }
    }

    /// What the controller runs on, in the words of `platebench run --rig`; `emulated` where not said. [`RIG_VARIABLE`] overrides it.
    #[must_use]
    pub fn rig(mut self, rig: impl Into<String>) -> Self {
        self.rig = rig.into();
        self
    }

    /// The test program: reads its arguments and the environment, plays what they ask for, and tells how it ended.
    ///
    /// 0: every test passed; 101: one did not; 2: no suite, because a scenario or the rig is invalid; 4: no suite, because there is no scenario.
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
                // Faults of files are shown as such.
                let is_shown = matches!(error, SuiteError::Scenarios(_));
                eprintln!("{}{error}", if is_shown { "" } else { "error: " });
                ExitCode::from(error.exit_code())
            }
        }
    }

    /// The tests, by name.
    fn tests(&self) -> Result<SuiteTests, SuiteError> {
        let rig: RigSpec = self.rig.parse().map_err(SuiteError::Rig)?;
        rig.check().map_err(SuiteError::Connect)?;
        let found = find(std::slice::from_ref(&self.scenarios)).map_err(SuiteError::Scenarios)?;
        let limits =
            found.skipped.iter().map(|name| load_limit_scenario(&self.scenarios, name)).collect::<Result<Vec<_>, _>>();
        let limits = limits.map_err(SuiteError::Scenarios)?;
        if found.scenarios.is_empty() && limits.is_empty() {
            return Err(SuiteError::NoScenarios(self.scenarios.clone()));
        }
        let one_at_a_time = !rig.allows_parallel_links();
        let stage = Arc::new(TestContext::new(rig, self.out.clone()));
        let judged = found.scenarios.into_iter().map(|scenario| (scenario, false));
        let mut scenarios: Vec<_> = judged.chain(limits.into_iter().map(|scenario| (scenario, true))).collect();
        scenarios.sort_by(|(a, _), (b, _)| a.file.cmp(&b.file));
        let test = |(scenario, ignored): (Scenario, bool)| {
            let stage = Arc::clone(&stage);
            let name = scenario.name().to_owned();
            Trial::test(name, move || stage.run_scenario(scenario).map_err(Into::into)).with_ignored_flag(ignored)
        };
        let trials = scenarios.into_iter().map(test).collect();
        Ok(SuiteTests { trials, one_at_a_time })
    }
}

/// What a suite comes to.
struct SuiteTests {
    trials: Vec<Trial>,
    /// True where all of them need the same line.
    one_at_a_time: bool,
}

/// The scenario called `name` that shows a limit and that [`find`] left out below `folder`.
fn load_limit_scenario(folder: &Path, name: &str) -> Result<Scenario, Vec<Diagnostic>> {
    let missing = || vec![Diagnostic::for_file(folder, format!("{name} was here a moment ago"))];
    let canonical = std::fs::canonicalize(folder).map_err(|_| missing())?;
    // A name is a path below the folder or below one that it lies in.
    let path = canonical.ancestors().map(|folder| folder.join(name)).find(|path| path.is_file()).ok_or_else(missing)?;
    let mut scenario = find(&[path])?.scenarios.pop().ok_or_else(missing)?;
    name.clone_into(&mut scenario.file);
    Ok(scenario)
}
