//! Lists the columns of a row, named as in the trace. Each flag is a column, so that programs can
//! filter by it.

use platebench_trace::{Flags, Row};

#[derive(Debug, Clone, Copy)]
pub struct Number {
    pub name: &'static str,
    pub unit: &'static str,
    pub meaning: &'static str,
    /// Reads the number from a row; NaN if it is unknown.
    pub of: fn(&Row) -> f64,
    /// True if the number is unknown for a real plate.
    pub can_be_unknown: bool,
}

impl Number {
    pub fn known_value(&self, row: &Row) -> Option<f64> {
        Some((self.of)(row)).filter(|value| !value.is_nan())
    }
}

#[derive(Debug, Clone, Copy)]
pub struct FlagColumn {
    /// Name of the flag in the trace, with `_` instead of `-`.
    pub name: &'static str,
    pub meaning: &'static str,
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

/// Time is the first column. Amplitudes and voltages are peak to peak.
pub const NUMBER_COLUMNS: [Number; 13] = [
    number!(t_s, "s", "time since the start of the trial"),
    number!(setpoint_um, "µm", "setpoint of the amplitude"),
    number!(wd_um, "µm", "in-phase component Wd of the plate's vibration"),
    number!(wq_um, "µm", "quadrature component Wq of the plate's vibration"),
    number!(amplitude_um, "µm", "amplitude |W| of the plate's vibration"),
    number!(drive_vpp, "V", "drive from this instant on, peak to peak"),
    number!(frequency_hz, "Hz", "excitation frequency from this instant on"),
    number!(resonance_hz, "Hz", "the plate's true resonance frequency", true),
    number!(temperature_offset_k, "K", "temperature above the plate's reference", true),
    number!(finger_force_n, "N", "normal force of the finger", true),
    number!(sensed_wd_um, "µm", "last in-phase component sent to the controller"),
    number!(sensed_wq_um, "µm", "last quadrature component sent to the controller"),
    number!(lateness_us, "µs", "lateness of the bench at this instant"),
];

pub const FLAG_COLUMNS: [FlagColumn; 6] = [
    FlagColumn {
        name: "control",
        meaning: "control instant: this state was sent to the controller",
        flag: Flags::CONTROL,
    },
    FlagColumn { name: "saturated", meaning: "the drive is at the amplifier's limit", flag: Flags::SATURATED },
    FlagColumn { name: "overrun", meaning: "the bench was too late for this instant", flag: Flags::OVERRUN },
    FlagColumn { name: "link_lost", meaning: "no answer, the last drive is held", flag: Flags::LINK_LOST },
    FlagColumn { name: "safe", meaning: "the controller is not running: 0 V", flag: Flags::SAFE },
    FlagColumn {
        name: "sensed",
        meaning: "reported by a controller with its own plate: motion from its sensor, unknown numbers missing",
        flag: Flags::SENSED,
    },
];

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_trace::{COLUMNS, OPTIONAL_COLUMNS};

    #[test]
    fn contains_every_column_of_a_trace() {
        let names: Vec<_> = NUMBER_COLUMNS.iter().map(|number| number.name).chain(["flags"]).collect();
        assert_eq!(names, COLUMNS);
        let optional: Vec<_> =
            NUMBER_COLUMNS.iter().filter(|number| number.can_be_unknown).map(|number| number.name).collect();
        assert_eq!(optional, OPTIONAL_COLUMNS);
        let all = FLAG_COLUMNS.iter().fold(Flags::empty(), |all, column| all | column.flag);
        assert_eq!((all, FLAG_COLUMNS.len()), (Flags::all(), Flags::all().iter().count()));
    }

    #[test]
    fn a_name_ends_in_its_unit() {
        for Number { name, unit, .. } in NUMBER_COLUMNS {
            let expected = match name.rsplit_once('_').unwrap().1 {
                "um" => "µm",
                "us" => "µs",
                "vpp" => "V",
                "hz" => "Hz",
                other => &other.to_uppercase(),
            };
            assert!(unit == expected || unit.to_uppercase() == expected, "{name} in {unit}");
        }
    }
}
