//! Parses `CHIP[@VID:PID[:SERIAL]]`, the board in `--rig probe:`.

use super::error::ProbeError;
use probe_rs::probe::DebugProbeSelector;
use std::fmt;
use std::str::FromStr;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProbeSpec {
    pub chip: String,
    /// `None` selects the only connected probe.
    pub selector: Option<DebugProbeSelector>,
}

impl FromStr for ProbeSpec {
    type Err = ProbeError;

    fn from_str(text: &str) -> Result<Self, ProbeError> {
        let (chip, selector) = text.split_once('@').map_or((text, None), |(chip, rest)| (chip, Some(rest)));
        let refuse = || ProbeError::Spec { text: text.to_owned() };
        if chip.is_empty() {
            return Err(refuse());
        }
        let selector = selector.map(str::parse).transpose().map_err(|_| refuse())?;
        Ok(Self { chip: chip.to_owned(), selector })
    }
}

impl fmt::Display for ProbeSpec {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.chip)?;
        self.selector.as_ref().map_or(Ok(()), |selector| write!(formatter, "@{selector}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_chip_and_selector_as_parsed() {
        for text in ["STM32F407VG", "STM32F427VI@0483:374b", "STM32F405RG@0d28:0204:0240A1:B2"] {
            assert_eq!(text.parse::<ProbeSpec>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn rejects_a_wrong_chip_or_selector() {
        for text in ["", "@0483:374b", "STM32F407VG@", "STM32F407VG@0483", "STM32F407VG@st:link"] {
            let error = text.parse::<ProbeSpec>().unwrap_err().to_string();
            assert!(error.contains("CHIP[@VID:PID[:SERIAL]]"), "{text}: {error}");
        }
    }
}
