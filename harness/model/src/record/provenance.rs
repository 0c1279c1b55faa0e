//! Records which build of the bench ran on which computer.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fs;
use std::sync::OnceLock;

/// The program's crate sets this value, because a new commit recompiles only that crate.
static RUNNING: OnceLock<Tool> = OnceLock::new();

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Tool {
    pub name: String,
    pub version: String,
    /// Commit of the built checkout. Changes that were not committed do not show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub commit: Option<String>,
    /// Cargo profile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub profile: Option<String>,
    /// Cargo features that are not on by default.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub features: Vec<String>,
}

impl Tool {
    pub fn set_running(self) {
        RUNNING.get_or_init(|| self);
    }

    /// Contains only name and version if [`Tool::set_running`] was not called.
    pub fn running() -> Self {
        let unnamed =
            || Self { name: "platebench".to_owned(), version: env!("CARGO_PKG_VERSION").to_owned(), ..Self::default() };
        RUNNING.get().cloned().unwrap_or_else(unnamed)
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Host {
    pub os: String,
    pub arch: String,
    /// Model name of the first processor, if the kernel reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kernel: Option<String>,
    /// Frequency governor of the first processor; absent in most virtual machines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub governor: Option<String>,
}

impl Host {
    pub fn current() -> Self {
        let line = |path: &str| fs::read_to_string(path).ok().map(|text| text.trim().to_owned());
        let processors = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        Self {
            os: std::env::consts::OS.to_owned(),
            arch: std::env::consts::ARCH.to_owned(),
            cpu: model_name(&processors),
            kernel: line("/proc/sys/kernel/osrelease"),
            governor: line("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
        }
    }
}

fn model_name(processors: &str) -> Option<String> {
    let (_, name) =
        processors.lines().filter_map(|line| line.split_once(':')).find(|(key, _)| key.trim() == "model name")?;
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_model_name_of_the_first_processor() {
        let text = "processor\t: 0\nmodel\t\t: 25\nmodel name\t: A CPU @ 2.0 GHz: fast\n\nmodel name\t: B\n";
        assert_eq!(model_name(text).as_deref(), Some("A CPU @ 2.0 GHz: fast"));
        assert_eq!(model_name("Hardware : board\nmodel name : \n"), None);
        assert!(Host::current().kernel.is_some_and(|release| !release.contains('\n')));
    }
}
