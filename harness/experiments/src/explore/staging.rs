//! Passes generated scenarios through the loader that reads every scenario.

use crate::explore::error::ExploreError;
use crate::explore::scenario_file::ScenarioText;
use platebench_model::scenario::{Scenario, load};
use platebench_model::trace::AtPath;
use std::collections::BTreeMap;
use std::fs;
use tempfile::TempDir;

const FILE: &str = "scene.toml";

pub(crate) struct Staging {
    folder: TempDir,
    plates: BTreeMap<String, String>,
}

impl Staging {
    pub(crate) fn new() -> Result<Self, ExploreError> {
        let folder = tempfile::tempdir().at(&std::env::temp_dir())?;
        let plates = folder.path().join("plates");
        fs::create_dir(&plates).at(&plates)?;
        Ok(Self { folder, plates: BTreeMap::new() })
    }

    pub(crate) fn load(&mut self, text: &ScenarioText) -> Result<Scenario, ExploreError> {
        for (name, content) in &text.plates {
            if self.plates.get(name) != Some(content) {
                let path = self.folder.path().join(name);
                fs::write(&path, content).at(&path)?;
                self.plates.insert(name.clone(), content.clone());
            }
        }
        let path = self.folder.path().join(FILE);
        fs::write(&path, &text.scenario).at(&path)?;
        load(&path, FILE).map_err(|fault| ExploreError::Generated(Box::new(fault)))
    }
}
