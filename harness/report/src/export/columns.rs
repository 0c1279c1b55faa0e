//! Lists the columns of a row. Each flag is a column, so that programs can filter by it.

use platebench_model::trace::{Column, Flags, OPTIONAL_COLUMNS, Row};

#[derive(Debug, Clone, Copy)]
pub struct Number {
    pub column: Column,
    pub unit: &'static str,
    pub meaning: &'static str,
}

impl Number {
    pub const fn name(&self) -> &'static str {
        self.column.name()
    }

    /// True if the number is unknown for a real plate.
    pub fn can_be_unknown(&self) -> bool {
        OPTIONAL_COLUMNS.contains(&self.column)
    }

    pub fn known_value(&self, row: &Row) -> Option<f64> {
        Some(self.column.value(row)).filter(|value| !value.is_nan())
    }
}

#[derive(Debug, Clone, Copy)]
pub struct FlagColumn {
    /// Name of the flag in the trace, with `_` instead of `-`.
    pub name: &'static str,
    pub meaning: &'static str,
    pub flag: Flags,
}

const fn number(column: Column, unit: &'static str, meaning: &'static str) -> Number {
    Number { column, unit, meaning }
}

/// Time is the first column. Amplitudes and voltages are peak to peak.
pub const NUMBER_COLUMNS: [Number; 13] = [
    number(Column::Time, "s", "time since the start of the trial"),
    number(Column::Setpoint, "µm", "setpoint of the amplitude"),
    number(Column::Wd, "µm", "in-phase component Wd of the plate's vibration"),
    number(Column::Wq, "µm", "quadrature component Wq of the plate's vibration"),
    number(Column::Amplitude, "µm", "amplitude |W| of the plate's vibration"),
    number(Column::Drive, "V", "drive from this instant on, peak to peak"),
    number(Column::Frequency, "Hz", "excitation frequency from this instant on"),
    number(Column::Resonance, "Hz", "the plate's true resonance frequency"),
    number(Column::Temperature, "K", "temperature above the plate's reference"),
    number(Column::Force, "N", "normal force of the finger"),
    number(Column::SensedWd, "µm", "last in-phase component sent to the controller"),
    number(Column::SensedWq, "µm", "last quadrature component sent to the controller"),
    number(Column::Lateness, "µs", "lateness of the bench at this instant"),
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
    use platebench_model::trace::COLUMNS;

    #[test]
    fn contains_every_column_of_a_trace() {
        let names: Vec<_> = NUMBER_COLUMNS.iter().map(Number::name).chain(["flags"]).collect();
        assert_eq!(names, COLUMNS);
        let optional: Vec<_> =
            NUMBER_COLUMNS.iter().filter(|number| number.can_be_unknown()).map(Number::name).collect();
        assert_eq!(optional, ["resonance_hz", "temperature_offset_k", "finger_force_n"]);
        let all = FLAG_COLUMNS.iter().fold(Flags::empty(), |all, column| all | column.flag);
        assert_eq!((all, FLAG_COLUMNS.len()), (Flags::all(), Flags::all().iter().count()));
    }

    #[test]
    fn a_name_ends_in_its_unit() {
        for number in NUMBER_COLUMNS {
            let (name, unit) = (number.name(), number.unit);
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
