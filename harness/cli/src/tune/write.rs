//! Gains into a scenario file: comments and layout stay, and the file is the old one or the new one, never half of either.

use platebench_analysis::tuning::design::Demand;
use platebench_plate::Time;
use platebench_scenario::{Diagnostic, load};
use platebench_wire::{Gains, LawId};
use std::fs;
use std::io::Write;
use std::path::Path;
use tempfile::NamedTempFile;
use toml_edit::{DocumentMut, Item, Table, TableLike, Value};

/// The f32 that the wire carries, as the shortest number that comes back as it.
pub(crate) fn shortest(gain: f32) -> f64 {
    gain.to_string().parse().unwrap_or_else(|_| f64::from(gain))
}

/// Writes `gains` into the scenario at `path`; what was done, in a sentence.
///
/// # Errors
/// A [`Diagnostic`] where the file is no scenario, is for another plate, period or kind of law, tells the law a delay, or cannot be replaced. Then it is as it was.
pub(crate) fn write(path: &Path, demand: &Demand<'_>, gains: Gains) -> Result<String, Diagnostic> {
    let refuse = |message: String| Diagnostic::of_file(path, message);
    let named = |error: std::io::Error| refuse(format!("cannot be written: {error}"));
    // What a link leads to is what is replaced.
    let file = fs::canonicalize(path).map_err(|error| refuse(format!("cannot be read: {error}")))?;
    let name = path.display().to_string();
    let scenario = load(&file, &name)?;
    if scenario.plate != *demand.plate {
        return Err(scenario.diagnose("plate", "another plate than the one tuned for: its gains would be wrong here"));
    }
    if scenario.controller.period.wrapping_micros() != demand.period_us {
        let message = format!("gains for a period of {} µs, expected the same here", demand.period_us);
        return Err(scenario.diagnose("controller.period_ms", message));
    }
    let law = LawId::from_name(&scenario.controller.law);
    if !law.is_some_and(|law| super::LAWS.contains(&law)) {
        let message = format!("`{}` has no gains of equation 24", scenario.controller.law);
        return Err(scenario.diagnose("controller.law", message));
    }
    if scenario.controller.design_delay != Time::ZERO {
        let message = "a law that is told its delay steers with it and is not the loop that was tuned";
        return Err(scenario.diagnose("controller.design_delay_ms", message));
    }
    let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = gains;
    let wanted = [amplitude_kp, amplitude_ki, frequency_kp, frequency_ki];
    let holds = |scenario: &platebench_scenario::Scenario| {
        scenario.controller.gains.is_some_and(|there| {
            [there.amplitude_kp, there.amplitude_ki, there.frequency_kp, there.frequency_ki].map(|gain| gain as f32)
                == wanted
        })
    };
    if holds(&scenario) {
        return Ok(format!("{name} has these gains already: left as it is"));
    }
    let text = fs::read_to_string(&file).map_err(|error| refuse(format!("cannot be read: {error}")))?;
    let mut document: DocumentMut = text.parse().map_err(|error| refuse(format!("cannot be edited: {error}")))?;
    let keys = ["amplitude_kp", "amplitude_ki", "frequency_kp", "frequency_ki"];
    let pairs = keys.into_iter().zip(wanted.map(shortest));
    put(&mut document, pairs).ok_or_else(|| refuse("has no [controller] that gains could be put into".to_owned()))?;
    // Beside the file, so that its plate and profiles are found, and so that it can take its place.
    let folder = file.parent().unwrap_or_else(|| Path::new("."));
    let mut beside = NamedTempFile::new_in(folder).map_err(named)?;
    beside.write_all(document.to_string().as_bytes()).map_err(named)?;
    let permissions = fs::metadata(&file).map_err(named)?.permissions();
    beside.as_file().set_permissions(permissions).map_err(named)?;
    beside.as_file().sync_all().map_err(named)?;
    let edited = load(beside.path(), &name)
        .map_err(|fault| refuse(format!("would no longer be a scenario, so it is as it was: {}", fault.message)))?;
    if !holds(&edited) {
        return Err(refuse("would not have the gains, so it is as it was".to_owned()));
    }
    beside.persist(&file).map_err(|error| named(error.error))?;
    Ok(format!("{name}: gains written into [controller.gains]"))
}

/// A table without a header of its own.
fn implicit() -> Item {
    let mut table = Table::new();
    table.set_implicit(true);
    Item::Table(table)
}

/// Sets the four numbers; `None` where `controller` or its gains are no tables.
fn put<'a>(document: &mut DocumentMut, pairs: impl Iterator<Item = (&'a str, f64)>) -> Option<()> {
    let root = document.as_table_mut();
    let inline = root.get("controller").is_some_and(Item::is_value);
    let controller: &mut dyn TableLike = root.entry("controller").or_insert_with(implicit).as_table_like_mut()?;
    let empty = || {
        if inline { Item::Value(Value::InlineTable(toml_edit::InlineTable::new())) } else { Item::Table(Table::new()) }
    };
    let gains = controller.entry("gains").or_insert_with(empty).as_table_like_mut()?;
    for (key, number) in pairs {
        match gains.get_mut(key).and_then(Item::as_value_mut) {
            Some(there) => {
                let decor = there.decor().clone();
                *there = Value::from(number);
                *there.decor_mut() = decor;
            }
            None => {
                gains.insert(key, toml_edit::value(number));
            }
        }
    }
    Some(())
}
