//! Defines a varied value.

use crate::campaign::distribution::{Choice, Distribution};

#[derive(Debug, Clone)]
pub struct Variable {
    pub key: String,
    pub distribution: Distribution,
}

impl Variable {
    pub fn is_number(&self) -> bool {
        self.distribution.choices().is_none_or(|list| list.iter().all(Choice::is_number))
    }

    pub fn short_name(&self) -> &str {
        self.key.rsplit('.').next().unwrap_or_default()
    }

    /// Formats a drawn value with at most six decimals.
    pub fn text(&self, drawn: f64) -> String {
        match self.distribution.number(drawn) {
            Some(number) => format!("{number:.6}").trim_end_matches('0').trim_end_matches('.').to_owned(),
            None => self.distribution.text(drawn),
        }
    }
}
