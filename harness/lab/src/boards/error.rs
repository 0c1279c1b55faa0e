//! Defines the errors of the inventory and of a reservation.

use platebench_model::scenario::Diagnostic;
use platebench_model::trace::FileError;
use platebench_rig::{ConnectError, LockHolder, RigError};
use std::path::PathBuf;

#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Inventory(Vec<Diagnostic>),
    #[error("no boards.toml in this folder or a folder above it, expected this file or --boards FILE")]
    NoInventory,
    #[error("{}: no board `{name}`, expected one of {known}", path.display())]
    Unknown { path: PathBuf, name: String, known: String },
    #[error(transparent)]
    File(#[from] FileError),
    #[error(
        "{}: the file is damaged: {source}; expected the state of the board as platebench wrote it",
        path.display()
    )]
    State { path: PathBuf, source: serde_json::Error },
    #[error("board {name} is held by {holder}{since}; --wait SECONDS waits for it")]
    Held {
        name: String,
        holder: LockHolder,
        /// Text ` since TIME` with the start of the reservation, or empty if it is unknown.
        since: String,
    },
    #[error(
        "board {name} is in quarantine since {since}: {reason}; check it, then: platebench board clear {name} \
         --reason TEXT"
    )]
    Quarantined { name: String, since: String, reason: String },
    #[error("board {name} is not in quarantine")]
    NotQuarantined { name: String },
    #[error("--reason is empty, expected a text that states what was checked on the board")]
    NoReason,
    #[error(
        "board {name}: the connected chip has the number {found}, boards.toml has {expected}; connect the right board \
         or correct boards.toml"
    )]
    WrongChip { name: String, found: String, expected: String },
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error("cancelled while waiting for board {0}")]
    Cancelled(String),
}

impl BoardError {
    /// True if the input is wrong, false if the board cannot be used now.
    pub fn is_invalid_input(&self) -> bool {
        match self {
            Self::Inventory(_)
            | Self::NoInventory
            | Self::Unknown { .. }
            | Self::File(_)
            | Self::State { .. }
            | Self::NotQuarantined { .. }
            | Self::NoReason => true,
            Self::Connect(error) => error.is_invalid_input(),
            Self::Held { .. }
            | Self::Quarantined { .. }
            | Self::WrongChip { .. }
            | Self::Rig(_)
            | Self::Cancelled(_) => false,
        }
    }
}
