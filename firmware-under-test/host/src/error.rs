//! Defines the errors of the program.

#[derive(Debug, thiserror::Error)]
pub(crate) enum HostError {
    #[error("cannot open {port}: {error}")]
    Open { port: String, error: std::io::Error },
    #[error("{port} cannot be set to {baud} baud: {error}")]
    Settings { port: String, baud: u32, error: std::io::Error },
    #[error("cannot write {file}: {error}")]
    Log { file: String, error: std::io::Error },
}
