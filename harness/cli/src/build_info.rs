//! Describes this build for `--version` and `run.json`.

use platebench_model::record::Tool;

const COMMIT: &str = env!("PLATEBENCH_BUILD_COMMIT");
const PROFILE: &str = env!("PLATEBENCH_BUILD_PROFILE");
const FEATURES: &str = env!("PLATEBENCH_BUILD_FEATURES");

fn non_empty(text: &str) -> Option<String> {
    (!text.is_empty()).then(|| text.to_owned())
}

pub(crate) fn tool() -> Tool {
    Tool {
        name: "platebench".to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        commit: non_empty(COMMIT),
        profile: non_empty(PROFILE),
        features: FEATURES.split_whitespace().map(str::to_owned).collect(),
    }
}

pub(crate) fn version() -> String {
    let Tool { version, commit, profile, features, .. } = tool();
    let commit = commit.unwrap_or_else(|| "unknown".to_owned());
    let features = if features.is_empty() { "none".to_owned() } else { features.join(", ") };
    format!("{version} (commit {commit}, profile {}, features: {features})", profile.unwrap_or_default())
}
