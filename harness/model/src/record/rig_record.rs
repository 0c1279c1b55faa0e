//! Records the rig and its firmware.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct RigRecord {
    /// Name of the rig, as on the command line.
    pub name: String,
    /// `null` if the firmware never identified itself.
    #[serde(default)]
    pub firmware: Option<Firmware>,
}

impl RigRecord {
    /// Kind of the rig without port or file, for example `emulated`.
    pub fn kind(&self) -> &str {
        self.name.split(':').next().unwrap_or_default()
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Firmware {
    pub name: String,
    pub version: String,
    /// Build identity, hexadecimal.
    pub build: String,
    /// Chip identity code, hexadecimal; zero for a program on a computer.
    pub chip: String,
}
