//! Parses the command line.

pub(crate) const USAGE: &str = "usage: platebench-host-controller PORT [--baud N] [--log FILE] [--unique HEX]";

const DEFAULT_BAUD: u32 = 1_000_000;

#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Arguments {
    pub(crate) port: String,
    pub(crate) baud: u32,
    pub(crate) log: Option<String>,
    /// Value that the program reports as unique number, because a computer has no chip number.
    pub(crate) unique: [u8; 12],
}

#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum UsageError {
    #[error("PORT is missing")]
    NoPort,
    #[error("only one PORT is allowed, found a second one: `{0}`")]
    SecondPort(String),
    #[error("unknown option `{0}`")]
    Unknown(String),
    #[error("`{0}` needs a value")]
    NoValue(String),
    #[error("invalid value `{0}` of --unique, expected 24 hexadecimal digits")]
    Unique(String),
    #[error("invalid baud rate `{0}`, expected a positive integer")]
    Baud(String),
}

impl Arguments {
    pub(crate) fn parse(mut words: impl Iterator<Item = String>) -> Result<Option<Self>, UsageError> {
        let (mut port, mut baud, mut log, mut unique) = (None, DEFAULT_BAUD, None, [0; 12]);
        while let Some(word) = words.next() {
            let mut value = || words.next().ok_or_else(|| UsageError::NoValue(word.clone()));
            match word.as_str() {
                "--help" | "-h" => return Ok(None),
                "--baud" => {
                    let text = value()?;
                    let number = text.parse().ok().filter(|&baud| baud > 0);
                    baud = number.ok_or(UsageError::Baud(text))?;
                }
                "--log" => log = Some(value()?),
                "--unique" => {
                    let text = value()?;
                    unique = parse_unique(&text).ok_or(UsageError::Unique(text))?;
                }
                option if option.starts_with('-') => return Err(UsageError::Unknown(word)),
                _ if port.is_some() => return Err(UsageError::SecondPort(word)),
                _ => port = Some(word),
            }
        }
        Ok(Some(Self { port: port.ok_or(UsageError::NoPort)?, baud, log, unique }))
    }
}

fn parse_unique(text: &str) -> Option<[u8; 12]> {
    let mut unique = [0; 12];
    if text.len() != 2 * unique.len() {
        return None;
    }
    for (index, byte) in unique.iter_mut().enumerate() {
        *byte = u8::from_str_radix(text.get(2 * index..2 * index + 2)?, 16).ok()?;
    }
    Some(unique)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(words: &[&str]) -> Result<Option<Arguments>, UsageError> {
        Arguments::parse(words.iter().map(|&word| word.to_owned()))
    }

    #[test]
    fn port_and_options_may_have_any_order() {
        let plain = Arguments { port: "/dev/pts/3".to_owned(), baud: 1_000_000, log: None, unique: [0; 12] };
        assert_eq!(parse(&["/dev/pts/3"]), Ok(Some(plain)));
        let whole = Arguments { port: "p".to_owned(), baud: 9_600, log: Some("l".to_owned()), unique: [0xab; 12] };
        let unique = "ab".repeat(12);
        assert_eq!(parse(&["--log", "l", "p", "--baud", "9600", "--unique", &unique]), Ok(Some(whole)));
        assert_eq!(parse(&["p", "--help"]), Ok(None));
    }
}
