//! Writes gains into a scenario file atomically. Comments and layout stay.

use super::arguments::LAWS;
use platebench_design::tuning::design::TuningTarget;
use platebench_design::tuning::verification::shortest_decimal;
use platebench_model::scenario::{Diagnostic, load, read_text};
use platebench_plate::Time;
use platebench_wire::{Gains, LawId};
use std::fs;
use std::io::Write;
use std::path::Path;
use tempfile::NamedTempFile;
use toml_edit::{DocumentMut, Item, Table, TableLike, Value};

/// Returns a message for the user. Leaves the file unchanged and fails if plate, period or kind of
/// law do not match the gains, or if the law has a design delay.
pub(crate) fn write_gains(path: &Path, target: &TuningTarget<'_>, gains: Gains) -> Result<String, Diagnostic> {
    let refuse = |message: String| Diagnostic::for_file(path, message);
    let cannot_write = |error: std::io::Error| refuse(format!("cannot be written: {error}"));
    // Replaces the target of a symbolic link, so that the link stays.
    let file = fs::canonicalize(path).map_err(|error| refuse(format!("cannot be read: {error}")))?;
    let name = path.display().to_string();
    let scenario = load(&file, &name)?;
    if *scenario.design_plate() != *target.plate {
        return Err(scenario.diagnostic("plate", "differs from the tuned plate, so the gains do not fit"));
    }
    if scenario.controller.period.wrapping_micros() != target.period_us {
        let message =
            format!("differs from the period of the gains, expected {} ms", f64::from(target.period_us) / 1e3);
        return Err(scenario.diagnostic("controller.period_ms", message));
    }
    let law = LawId::from_name(&scenario.controller.law);
    if !law.is_some_and(|law| LAWS.contains(&law)) {
        let message = format!("`{}` does not use the gains of equation 24", scenario.controller.law);
        return Err(scenario.diagnostic("controller.law", message));
    }
    if scenario.controller.design_delay != Time::ZERO {
        let message = "the gains are for a law that does not compensate a delay; remove this key";
        return Err(scenario.diagnostic("controller.design_delay_ms", message));
    }
    let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = gains;
    let wanted = [amplitude_kp, amplitude_ki, frequency_kp, frequency_ki];
    let has_gains = |scenario: &platebench_model::scenario::Scenario| {
        scenario.controller.gains.is_some_and(|gains| {
            [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki].map(|gain| gain as f32)
                == wanted
        })
    };
    if has_gains(&scenario) {
        return Ok(format!("{name} has these gains already and is unchanged"));
    }
    let text = read_text(&file)?;
    let mut document: DocumentMut = text.parse().map_err(|error| refuse(format!("cannot be edited: {error}")))?;
    let keys = ["amplitude_kp", "amplitude_ki", "frequency_kp", "frequency_ki"];
    let pairs = keys.into_iter().zip(wanted.map(shortest_decimal));
    set_gains(&mut document, pairs).ok_or_else(|| refuse("`controller` is not a table".to_owned()))?;
    // A new file in the same folder keeps relative paths valid and allows an atomic rename.
    let folder = file.parent().unwrap_or_else(|| Path::new("."));
    let mut edited_file = NamedTempFile::new_in(folder).map_err(cannot_write)?;
    edited_file.write_all(document.to_string().as_bytes()).map_err(cannot_write)?;
    let permissions = fs::metadata(&file).map_err(cannot_write)?.permissions();
    edited_file.as_file().set_permissions(permissions).map_err(cannot_write)?;
    edited_file.as_file().sync_all().map_err(cannot_write)?;
    let edited = load(edited_file.path(), &name).map_err(|fault| {
        refuse(format!("the edited file is not a valid scenario, so nothing was written: {}", fault.message))
    })?;
    if !has_gains(&edited) {
        return Err(refuse("the edited file does not have the gains, so nothing was written".to_owned()));
    }
    edited_file.persist(&file).map_err(|error| cannot_write(error.error))?;
    Ok(format!("{name}: gains written into [controller.gains]"))
}

fn implicit_table() -> Item {
    let mut table = Table::new();
    table.set_implicit(true);
    Item::Table(table)
}

fn set_gains<'a>(document: &mut DocumentMut, pairs: impl Iterator<Item = (&'a str, f64)>) -> Option<()> {
    let root = document.as_table_mut();
    let inline = root.get("controller").is_some_and(Item::is_value);
    let controller: &mut dyn TableLike = root.entry("controller").or_insert_with(implicit_table).as_table_like_mut()?;
    let empty = || {
        if inline { Item::Value(Value::InlineTable(toml_edit::InlineTable::new())) } else { Item::Table(Table::new()) }
    };
    let gains = controller.entry("gains").or_insert_with(empty).as_table_like_mut()?;
    for (key, number) in pairs {
        match gains.get_mut(key).and_then(Item::as_value_mut) {
            Some(value) => {
                let decor = value.decor().clone();
                *value = Value::from(number);
                *value.decor_mut() = decor;
            }
            None => {
                gains.insert(key, toml_edit::value(number));
            }
        }
    }
    Some(())
}
