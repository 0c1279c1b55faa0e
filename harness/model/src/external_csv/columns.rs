//! Parses which column of a table has which role and unit.

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use std::f64::consts::{PI, SQRT_2, TAU};
use std::str::FromStr;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ColumnRole {
    Time,
    Drive,
    Frequency,
    Wd,
    Wq,
    Amplitude,
    Phase,
    Temperature,
    Force,
    Setpoint,
}

impl ColumnRole {
    pub(super) const COUNT: usize = ROLES.len();
}

/// Names of units with their factors to s, Vpp, rad/s, µm peak to peak, rad, K and N.
type Units = &'static [(&'static str, f64)];
const AMPLITUDES: Units = &[
    ("um", 1.0),
    ("nm", 1e-3),
    ("m", 1e6),
    ("um_pk", 2.0),
    ("nm_pk", 2e-3),
    ("um_rms", 2.0 * SQRT_2),
    ("nm_rms", 2e-3 * SQRT_2),
];
/// Name of the role, role, units, and whether a reversed sign is possible.
pub(super) const ROLES: [(&str, ColumnRole, Units, bool); 10] = [
    ("time", ColumnRole::Time, &[("s", 1.0), ("ms", 1e-3), ("us", 1e-6), (INSTANT, 1.0)], false),
    (
        "drive",
        ColumnRole::Drive,
        &[("Vpp", 1.0), ("V", 2.0), ("Vrms", 2.0 * SQRT_2), ("mVpp", 1e-3), ("mV", 2e-3), ("mVrms", 2e-3 * SQRT_2)],
        false,
    ),
    ("frequency", ColumnRole::Frequency, &[("Hz", TAU), ("kHz", TAU * 1e3), ("rad/s", 1.0)], false),
    ("wd", ColumnRole::Wd, AMPLITUDES, true),
    ("wq", ColumnRole::Wq, AMPLITUDES, true),
    ("amplitude", ColumnRole::Amplitude, AMPLITUDES, false),
    ("phase", ColumnRole::Phase, &[("deg", PI / 180.0), ("rad", 1.0)], true),
    ("temperature", ColumnRole::Temperature, &[("K", 1.0), (CELSIUS, 1.0)], false),
    ("force", ColumnRole::Force, &[("N", 1.0), ("mN", 1e-3)], false),
    ("setpoint", ColumnRole::Setpoint, AMPLITUDES, false),
];
/// Unit of a column with a date and a time, ISO 8601.
const INSTANT: &str = "datetime";
/// Followed by the reference temperature, as in `degC-24`.
const CELSIUS: &str = "degC-REFERENCE";

/// How the number of a cell becomes a value in the unit of the role.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Scale {
    Factor {
        factor: f64,
        /// Subtracted from the number before the multiplication.
        offset: f64,
    },
    /// The cell is a date and a time.
    Instant,
    /// A value in the unit of the role that holds in every row.
    Constant(f64),
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Column {
    pub(super) role: ColumnRole,
    /// Title, with `#2` for the second column of this title.
    pub(super) title: String,
    unit: String,
    is_scaled: bool,
    pub(super) scale: Scale,
}

impl Column {
    /// Fails if the unit below the title is a known unit of the role with another factor.
    pub(super) fn check_unit(&self, found: &str) -> Result<(), String> {
        let Scale::Factor { factor, .. } = self.scale else { return Ok(()) };
        // A scaled column has the unit of the instrument.
        if self.is_scaled {
            return Ok(());
        }
        let units = ROLES.iter().find(|role| role.1 == self.role).map_or(&[][..], |role| role.2);
        let found = canonical_unit(found);
        match units.iter().find(|unit| unit.0 == found) {
            Some((_, other)) if (other / factor.abs() - 1.0).abs() > 1e-9 => Err(format!(
                "the column `{}` has the unit `{found}`, but --columns names `{}`; expected the same unit",
                self.title, self.unit
            )),
            _ => Ok(()),
        }
    }
}

/// `µ` is written as `u`.
pub(super) fn canonical_unit(text: &str) -> String {
    text.trim().replace(['µ', 'μ'], "u")
}

/// `time=COLUMN:UNIT,drive=…,frequency=…,wd=…,wq=…[,temperature=…][,force=…][,setpoint=…]`, with
/// `amplitude=…,phase=…` in place of `wd=…,wq=…` for a lock-in.
///
/// Every role needs a unit, because `drive=V` could name a column or a unit, and a title `V` does not
/// say whether it is peak, peak to peak or RMS. `#2` after a title names the second column of this
/// title. Units: time s, ms, us, datetime (ISO 8601) · drive Vpp, V (amplitude, half of Vpp), Vrms,
/// each also with m · frequency Hz, kHz, rad/s · wd, wq, amplitude and setpoint um, nm, m (peak to
/// peak), `um_pk`, `nm_pk`, `um_rms`, `nm_rms` · phase deg, rad · temperature K above the reference,
/// or `degC-24` with the reference · force N, mN. `NUMBER*` before the unit scales the column, as
/// `CH2:0.5*um` for 0.5 µm per volt; `=NUMBER` in place of a column holds in every row. `-` before the
/// unit of wd, wq and phase reverses the sign. Drive and frequency of a row act from the time of the
/// row on; Wd and Wq are sampled at this time.
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnMapping(Vec<Column>);

impl ColumnMapping {
    /// The roles that a column of the table has.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Column> {
        self.0.iter().filter(|column| !matches!(column.scale, Scale::Constant(_)))
    }

    pub(super) fn constants(&self) -> impl Iterator<Item = (ColumnRole, f64)> {
        self.0.iter().filter_map(|column| match column.scale {
            Scale::Constant(value) => Some((column.role, value)),
            _ => None,
        })
    }

    pub(super) fn has(&self, role: ColumnRole) -> bool {
        self.0.iter().any(|column| column.role == role)
    }

    /// Name of the first role that the mapping lacks.
    fn missing_role(&self) -> Option<&'static str> {
        let is_polar = self.has(ColumnRole::Amplitude) || self.has(ColumnRole::Phase);
        let response =
            if is_polar { [ColumnRole::Amplitude, ColumnRole::Phase] } else { [ColumnRole::Wd, ColumnRole::Wq] };
        let required = [ColumnRole::Time, ColumnRole::Drive, ColumnRole::Frequency].into_iter().chain(response);
        let missing = required.into_iter().find(|role| !self.has(*role))?;
        ROLES.iter().find(|role| role.1 == missing).map(|role| role.0)
    }
}

impl FromStr for ColumnMapping {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut columns: Vec<Column> = Vec::new();
        for part in text.split(',') {
            let column = parse_column(part)?;
            if columns.iter().any(|known| known.role == column.role) {
                let key = part.split('=').next().unwrap_or_default().trim();
                return Err(format!("two columns for the role {key}, expected one"));
            }
            let is_constant = matches!(column.scale, Scale::Constant(_));
            if !is_constant && columns.iter().any(|known| known.title == column.title) {
                return Err(format!("the column `{}` has two roles, expected one", column.title));
            }
            columns.push(column);
        }
        let mapping = Self(columns);
        if mapping.has(ColumnRole::Amplitude) && (mapping.has(ColumnRole::Wd) || mapping.has(ColumnRole::Wq)) {
            return Err("columns for amplitude and for wd or wq, expected amplitude and phase, or wd and wq".to_owned());
        }
        mapping
            .missing_role()
            .map_or(Ok(mapping), |role| Err(format!("no column for the role {role}, expected {role}=COLUMN:UNIT")))
    }
}

fn parse_column(part: &str) -> Result<Column, String> {
    let known = || ROLES.map(|role| role.0).join(", ");
    let (key, rest) = part
        .split_once('=')
        .ok_or_else(|| format!("`{part}`, expected ROLE=COLUMN:UNIT with a role of {}", known()))?;
    let found = ROLES.iter().find(|role| role.0 == key.trim());
    let (_, role, units, is_signed) = *found.ok_or_else(|| format!("`{key}`, expected a role of {}", known()))?;
    let listed = units.iter().map(|unit| unit.0).collect::<Vec<_>>().join(" or ");
    let (title, unit) = rest.rsplit_once(':').ok_or_else(|| {
        format!("`{part}` names the column `{rest}` without its unit, expected {part}:UNIT with {listed}")
    })?;
    let number = |text: &str| text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    let (scaled, unit, is_scaled) = match unit.split_once('*') {
        Some((text, unit)) => {
            let factor = number(text).filter(|factor| *factor > 0.0);
            (factor.ok_or_else(|| format!("`{text}` in {part}, expected a number above 0"))?, unit, true)
        }
        None => (1.0, unit, false),
    };
    let unit = canonical_unit(unit);
    let (sign, bare) = match unit.strip_prefix('-').filter(|_| is_signed) {
        Some(bare) => (-1.0, bare),
        None => (1.0, unit.as_str()),
    };
    let scale = match units.iter().find(|known| known.0 == bare) {
        Some((INSTANT, _)) => Some(Scale::Instant),
        Some((CELSIUS, _)) => None,
        Some((_, factor)) => Some(Scale::Factor { factor: factor * sign * scaled, offset: 0.0 }),
        None if role == ColumnRole::Temperature => {
            let reference = bare.replace('°', "deg").strip_prefix("degC-").and_then(|text| text.parse().ok());
            let reference = reference.filter(|reference: &f64| reference.is_finite());
            reference.map(|offset| Scale::Factor { factor: 1.0, offset })
        }
        None => None,
    };
    let scale = scale.ok_or_else(|| format!("unit `{unit}` of {key}, expected {listed}"))?;
    let title = title.trim().to_owned();
    if let Some(text) = title.strip_prefix('=') {
        let constant = number(text).zip(match scale {
            Scale::Factor { factor, offset } => Some((factor, offset)),
            _ => None,
        });
        let (value, (factor, offset)) = constant.ok_or_else(|| format!("`{part}`, expected {key}==NUMBER:UNIT"))?;
        let value = (value - offset) * factor;
        match role {
            ColumnRole::Time => return Err(format!("`{part}` is a constant time, expected a column")),
            ColumnRole::Frequency if value <= 0.0 => return Err(format!("`{part}`, expected a frequency above 0")),
            ColumnRole::Drive | ColumnRole::Amplitude if value < 0.0 => {
                return Err(format!("`{part}`, expected 0 or more"));
            }
            _ => return Ok(Column { role, title, unit, is_scaled, scale: Scale::Constant(value) }),
        }
    }
    if title.is_empty() {
        return Err(format!("`{part}` names no column, expected {key}=COLUMN:{unit}"));
    }
    Ok(Column { role, title, unit, is_scaled, scale })
}

/// Nanoseconds since 1970. A time without an offset from UTC counts as UTC.
pub(super) fn parse_instant(text: &str) -> Option<i128> {
    let stamp = text.parse::<Timestamp>().ok();
    let stamp = stamp.or_else(|| text.parse::<DateTime>().ok()?.to_zoned(TimeZone::UTC).ok().map(|at| at.timestamp()));
    stamp.map(Timestamp::as_nanosecond)
}
