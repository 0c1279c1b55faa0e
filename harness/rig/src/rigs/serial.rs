//! Connects to a controller on a serial port, and checks whether a baud rate suffices for a control
//! period.

use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::BoxedLink;
use crate::serial_port::{SerialError, SerialLink};
use platebench_model::record::ClockKind;
use std::path::PathBuf;
use std::time::Duration;

pub(super) const RIG: RigFactory = RigFactory {
    name: "serial",
    argument: Argument::Required("PORT[@BAUD]"),
    help: "a board on a serial port of this computer",
    capabilities: &[Capability::RealPlate, Capability::LocalPort],
    parse: |text| {
        let (port, baud) = parse_port(text.unwrap_or_default())?;
        Ok(Box::new(SerialRig { port: port.into(), baud }))
    },
};

#[derive(Debug)]
struct SerialRig {
    port: PathBuf,
    baud: u32,
}

impl Rig for SerialRig {
    fn properties(&self) -> RigProperties {
        RigProperties { default_clock: ClockKind::RealTime, baud: Some(self.baud), ..RigProperties::default() }
    }

    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        let link = SerialLink::open(&self.port, self.baud)?;
        Ok(Box::new(link.with_options(options)))
    }
}

/// Parses `PORT[@BAUD]`.
pub(super) fn parse_port(text: &str) -> Result<(String, u32), &'static str> {
    let (port, baud) = text.rsplit_once('@').map_or((text, None), |(port, baud)| (port, Some(baud)));
    match baud.map_or(Ok(DEFAULT_BAUD), str::parse) {
        Ok(baud) if baud > 0 && !port.is_empty() => Ok((port.to_owned(), baud)),
        _ => Err("the port is missing, or the baud rate is not a whole number above 0"),
    }
}

/// Baud rate of the bench's firmware.
const DEFAULT_BAUD: u32 = 1_000_000;

impl From<SerialError> for ConnectError {
    fn from(error: SerialError) -> Self {
        let is_invalid = matches!(error, SerialError::NotATerminal { .. } | SerialError::Settings { .. });
        Self::new(error, is_invalid)
    }
}

const CYCLIC_FRAME_BYTES: f64 = 24.0;
const BITS_PER_BYTE: f64 = 10.0;

const STANDARD_RATES: [u32; 19] = [
    9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 500_000, 576_000, 921_600, 1_000_000, 1_152_000,
    1_500_000, 2_000_000, 2_500_000, 3_000_000, 3_500_000, 4_000_000, 12_000_000,
];

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "{baud} baud cannot carry a sample and a command every {} µs: each takes {frame_us:.0} µs; {}",
    period.as_micros(),
    match smallest {
        Some(rate) => format!("{rate} baud is enough"),
        None => "no common rate is enough, use a longer period or a smaller time scale".to_owned(),
    }
)]
pub struct BaudTooLow {
    pub baud: u32,
    pub period: Duration,
    pub frame_us: f64,
    pub smallest: Option<u32>,
}

/// Lowest common baud rate at which a sample and then its command fit into one period. `time_scale`
/// is in plate seconds per wall second.
pub fn minimum_baud(period: Duration, time_scale: f64) -> Option<u32> {
    let needed = 2.0 * CYCLIC_FRAME_BYTES * BITS_PER_BYTE / wall_seconds(period, time_scale);
    STANDARD_RATES.into_iter().find(|&rate| f64::from(rate) >= needed)
}

/// Fails if a frame in one direction takes longer than a control period. Both directions transmit
/// at the same time. A law can still fail at this rate, because the loop delay is too long.
pub fn check_baud(baud: u32, period: Duration, time_scale: f64) -> Result<(), BaudTooLow> {
    let wall = wall_seconds(period, time_scale);
    let frame = CYCLIC_FRAME_BYTES * BITS_PER_BYTE / f64::from(baud);
    // This condition is false if `wall` is NaN.
    if frame <= wall {
        return Ok(());
    }
    Err(BaudTooLow {
        baud,
        period: Duration::try_from_secs_f64(wall).unwrap_or_default(),
        frame_us: frame * 1e6,
        smallest: minimum_baud(period, time_scale),
    })
}

fn wall_seconds(period: Duration, time_scale: f64) -> f64 {
    period.as_secs_f64() / time_scale
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn accepts_a_frame_that_just_fits_into_a_period() {
        for (scale, lowest) in [(1.0, 240_000), (0.1, 24_000)] {
            assert_eq!(check_baud(lowest, MS, scale), Ok(()));
            assert!(check_baud(lowest - 1, MS, scale).is_err());
        }
        assert_eq!(
            check_baud(115_200, MS, 1.0).unwrap_err().to_string(),
            "115200 baud cannot carry a sample and a command every 1000 µs: each takes 2083 µs; 500000 baud is enough"
        );
    }

    #[test]
    fn finds_the_lowest_common_rate() {
        // 480 bits in 480 µs are exactly 1 Mbaud.
        for (period_us, scale, rate) in [
            (1_000, 0.1, Some(57_600)),
            (1_000, 1.0, Some(500_000)),
            (480, 1.0, Some(1_000_000)),
            (479, 1.0, Some(1_152_000)),
            (10, 1.0, None),
        ] {
            assert_eq!(minimum_baud(Duration::from_micros(period_us), scale), rate, "{period_us} µs at {scale}");
        }
    }

    #[test]
    fn rejects_what_no_line_can_carry() {
        let error = check_baud(12_000_000, Duration::from_micros(10), 1.0).unwrap_err().to_string();
        assert!(error.ends_with("no common rate is enough, use a longer period or a smaller time scale"), "{error}");
        for (baud, period, scale) in
            [(1_000_000, MS, f64::NAN), (1_000_000, MS, f64::INFINITY), (0, MS, 1.0), (1_000_000, Duration::ZERO, 1.0)]
        {
            assert!(check_baud(baud, period, scale).is_err(), "{baud} {period:?} {scale}");
        }
    }
}
