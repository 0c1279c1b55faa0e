//! What every format holds of a row: names, units, meanings.
//!
//! Names are those of the trace. Its flags are a column each, because that is what other programs can filter by.

use platebench_trace::{Flags, Row};

/// A number of a row.
#[derive(Debug, Clone, Copy)]
pub struct Number {
    /// The column's name in the trace.
    pub name: &'static str,
    /// Its unit.
    pub unit: &'static str,
    /// What it is, in a sentence without an end.
    pub meaning: &'static str,
    /// Its value; NaN where nobody knows it.
    pub of: fn(&Row) -> f64,
    /// True where a real plate's trace may not know it.
    pub can_be_unknown: bool,
}

impl Number {
    /// Its value where somebody knows it.
    pub fn known_value(&self, row: &Row) -> Option<f64> {
        Some((self.of)(row)).filter(|value| !value.is_nan())
    }
}

/// A flag of a row.
#[derive(Debug, Clone, Copy)]
pub struct FlagColumn {
    /// The flag's name in the trace, with `_` instead of `-`.
    pub name: &'static str,
    /// What it says where it is set.
    pub meaning: &'static str,
    /// The flag.
    pub flag: Flags,
}

macro_rules! number {
    ($field:ident, $unit:literal, $meaning:literal) => {
        number!($field, $unit, $meaning, false)
    };
    ($field:ident, $unit:literal, $meaning:literal, $can_be_unknown:literal) => {
        Number {
            name: stringify!($field),
            unit: $unit,
            meaning: $meaning,
            of: |row| row.$field,
            can_be_unknown: $can_be_unknown,
        }
    };
}

/// The numbers of a row, time first. Amplitudes and voltages are peak to peak.
pub const NUMBER_COLUMNS: [Number; 13] = [
    number!(t_s, "s", "time since the start of the trial"),
    number!(setpoint_um, "µm", "wished amplitude"),
    number!(wd_um, "µm", "in-phase component Wd of the plate's vibration"),
    number!(wq_um, "µm", "quadrature component Wq of the plate's vibration"),
    number!(amplitude_um, "µm", "amplitude |W| of the plate's vibration"),
    number!(drive_vpp, "V", "drive from here on, peak to peak"),
    number!(frequency_hz, "Hz", "excitation frequency from here on"),
    number!(resonance_hz, "Hz", "the plate's true resonance frequency", true),
    number!(temperature_offset_k, "K", "temperature above the plate's reference", true),
    number!(finger_force_n, "N", "normal force of the finger", true),
    number!(sensed_wd_um, "µm", "in-phase component that the controller was last given"),
    number!(sensed_wq_um, "µm", "quadrature component that the controller was last given"),
    number!(lateness_us, "µs", "how late the bench was at this instant"),
];

/// The flags of a row.
pub const FLAG_COLUMNS: [FlagColumn; 6] = [
    FlagColumn {
        name: "control",
        meaning: "control instant: the controller was given this state",
        flag: Flags::CONTROL,
    },
    FlagColumn { name: "saturated", meaning: "the drive is at the amplifier's limit", flag: Flags::SATURATED },
    FlagColumn { name: "overrun", meaning: "the bench was too late for this instant", flag: Flags::OVERRUN },
    FlagColumn { name: "link_lost", meaning: "no answer came, the last drive is held", flag: Flags::LINK_LOST },
    FlagColumn { name: "safe", meaning: "the controller is not running: 0 V", flag: Flags::SAFE },
    FlagColumn {
        name: "sensed",
        meaning: "told by a controller that drives a plate of its own: motion is its sensor's, what nobody knows is missing",
        flag: Flags::SENSED,
    },
];

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_trace::{COLUMNS, OPTIONAL_COLUMNS};

    #[test]
    fn nothing_of_a_trace_is_left_out() {
        let names: Vec<_> = NUMBER_COLUMNS.iter().map(|number| number.name).chain(["flags"]).collect();
        assert_eq!(names, COLUMNS);
        let unknowable: Vec<_> =
            NUMBER_COLUMNS.iter().filter(|number| number.can_be_unknown).map(|number| number.name).collect();
        assert_eq!(unknowable, OPTIONAL_COLUMNS);
        let all = FLAG_COLUMNS.iter().fold(Flags::empty(), |all, mark| all | mark.flag);
        assert_eq!((all, FLAG_COLUMNS.len()), (Flags::all(), Flags::all().iter().count()));
    }

    #[test]
    fn a_name_ends_in_its_unit() {
        for Number { name, unit, .. } in NUMBER_COLUMNS {
            let said = match name.rsplit_once('_').unwrap().1 {
                "um" => "µm",
                "us" => "µs",
                "vpp" => "V",
                "hz" => "Hz",
                other => &other.to_uppercase(),
            };
            assert!(unit == said || unit.to_uppercase() == said, "{name} in {unit}");
        }
    }
}
