//! Defines a row of a trace and its columns.

bitflags::bitflags! {
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub struct Flags: u8 {
        /// The row is a control instant. The controller received this state as a sample.
        const CONTROL = 1;
        /// The drive is at the amplifier's limit.
        const SATURATED = 1 << 1;
        /// The bench reached this control instant too late.
        const OVERRUN = 1 << 2;
        /// A reply of the controller is missing, so the last drive continues.
        const LINK_LOST = 1 << 3;
        /// The controller has stopped, and the drive is 0 V.
        const SAFE = 1 << 4;
        /// Row of a real plate: amplitudes are from its sensor, unmeasured quantities are empty.
        const SENSED = 1 << 5;
    }
}

const NAMES: [(Flags, &str); 6] = [
    (Flags::CONTROL, "control"),
    (Flags::SATURATED, "saturated"),
    (Flags::OVERRUN, "overrun"),
    (Flags::LINK_LOST, "link-lost"),
    (Flags::SAFE, "safe"),
    (Flags::SENSED, "sensed"),
];

impl Flags {
    pub(crate) fn names(self) -> impl Iterator<Item = &'static str> {
        NAMES.iter().filter(move |(flag, _)| self.contains(*flag)).map(|(_, name)| *name)
    }

    /// On failure, the error is the unknown name.
    pub(crate) fn parse(text: &str) -> Result<Self, &str> {
        text.split('|').filter(|name| !name.is_empty()).try_fold(Self::empty(), |flags, name| {
            NAMES.iter().find(|(_, known)| *known == name).map(|(flag, _)| flags | *flag).ok_or(name)
        })
    }
}

macro_rules! define_row {
    ($($(#[$doc:meta])* $variant:ident $column:ident,)+) => {
        /// The state of a trial at an instant. Amplitudes and voltages are peak to peak.
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        pub struct Row {
            $($(#[$doc])* pub $column: f64,)+
            pub flags: Flags,
        }

        pub const COLUMNS: [&str; NUMBERS + 1] = [$(stringify!($column),)+ "flags"];

        /// Numbers of a row, in the order of [`COLUMNS`] without `flags`.
        pub(crate) const NUMBERS: usize = [$(stringify!($column)),+].len();

        /// A column with a number.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Column {
            $($variant,)+
        }

        impl Column {
            pub const ALL: [Self; NUMBERS] = [$(Self::$variant),+];

            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => stringify!($column),)+
                }
            }

            pub const fn value(self, row: &Row) -> f64 {
                match self {
                    $(Self::$variant => row.$column,)+
                }
            }

            pub fn from_name(name: &str) -> Option<Self> {
                Self::ALL.into_iter().find(|column| column.name() == name)
            }
        }

        impl Row {
            pub(crate) const fn numbers(&self) -> [f64; NUMBERS] {
                [$(self.$column),+]
            }

            pub(crate) const fn from_numbers([$($column),+]: [f64; NUMBERS], flags: Flags) -> Self {
                Self { $($column,)+ flags }
            }
        }
    };
}

define_row! {
    Time t_s,
    Setpoint setpoint_um,
    /// In-phase component of W.
    Wd wd_um,
    /// Quadrature component of W.
    Wq wq_um,
    Amplitude amplitude_um,
    Drive drive_vpp,
    Frequency frequency_hz,
    /// The plate's true resonance ω0/2π; NaN, and empty in the file, if unknown.
    Resonance resonance_hz,
    /// Kelvin above the plate's reference temperature; NaN, and empty in the file, if not measured.
    Temperature temperature_offset_k,
    /// Normal force of the finger, N; NaN, and empty in the file, if not measured.
    Force finger_force_n,
    /// In-phase component that the controller received last, with the sensor's errors.
    SensedWd sensed_wd_um,
    /// Quadrature component that the controller received last, with the sensor's errors.
    SensedWq sensed_wq_um,
    Lateness lateness_us,
}

/// Columns that may be empty in a row with the flag `sensed`.
pub const OPTIONAL_COLUMNS: [Column; 3] = [Column::Resonance, Column::Temperature, Column::Force];
