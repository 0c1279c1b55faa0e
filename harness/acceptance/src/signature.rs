//! `manifest.sha256.sig`: who vouches for the manifest.
//!
//! Ed25519 over the manifest's bytes, 64 bytes as they are; keys in PEM as OpenSSL writes them. There is no key format and no key store of our own:
//! `openssl genpkey -algorithm ed25519` makes a key and `openssl pkeyutl -verify -rawin` checks a signature as well.

use crate::error::AcceptError;
use ed25519_dalek::pkcs8::spki::der::pem::{LineEnding, decode_label};
use ed25519_dalek::pkcs8::{DecodePrivateKey, DecodePublicKey, EncodePublicKey};
use ed25519_dalek::{Signature, Signer as _, SigningKey, VerifyingKey};
use platebench_record::sha256;
use std::fs;
use std::path::Path;

/// The signature's name in a record.
pub const FILE: &str = "manifest.sha256.sig";

/// What a record is signed with.
#[derive(Clone)]
pub struct SecretKey(SigningKey);

/// What a signature is checked with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublicKey(VerifyingKey);

impl SecretKey {
    /// Reads a key from PKCS #8 in PEM.
    ///
    /// # Errors
    /// [`AcceptError::Io`], [`AcceptError::Key`].
    pub fn read(path: &Path) -> Result<Self, AcceptError> {
        let text = fs::read_to_string(path).map_err(AcceptError::io(path))?;
        SigningKey::from_pkcs8_pem(&text).map(Self).map_err(|error| key_error(path, &text, &error.to_string()))
    }

    /// The key that checks what this one signs.
    pub fn public_key(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }

    /// The signature of `content`.
    pub(crate) fn sign(&self, content: &[u8]) -> [u8; Signature::BYTE_SIZE] {
        self.0.sign(content).to_bytes()
    }
}

impl std::fmt::Debug for SecretKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_tuple("SecretKey").field(&self.public_key().fingerprint()).finish()
    }
}

impl PublicKey {
    /// Reads a key from SPKI in PEM.
    ///
    /// # Errors
    /// [`AcceptError::Io`], [`AcceptError::Key`].
    pub fn read(path: &Path) -> Result<Self, AcceptError> {
        let text = fs::read_to_string(path).map_err(AcceptError::io(path))?;
        VerifyingKey::from_public_key_pem(&text).map(Self).map_err(|error| key_error(path, &text, &error.to_string()))
    }

    /// The key in `text`; `None` where there is none.
    pub(crate) fn from_pem(text: &str) -> Option<Self> {
        VerifyingKey::from_public_key_pem(text).ok().map(Self)
    }

    /// The key in PEM; empty where it cannot be written so.
    pub(crate) fn to_pem(&self) -> String {
        self.0.to_public_key_pem(LineEnding::LF).unwrap_or_default()
    }

    /// SHA-256 of the key's 32 bytes, hexadecimal: what two people can compare.
    pub fn fingerprint(&self) -> String {
        sha256(self.0.as_bytes())
    }

    /// True where `signature` is this key's of `content`. Keys and signatures that fit many messages are refused.
    pub(crate) fn verifies(&self, content: &[u8], signature: &[u8]) -> bool {
        Signature::from_slice(signature).is_ok_and(|signature| self.0.verify_strict(content, &signature).is_ok())
    }
}

/// Why what `text` holds was not the key that was wanted: the other one of the pair, or what its reader says.
fn key_error(path: &Path, text: &str, error: &str) -> AcceptError {
    let shown = path.display();
    let message = match decode_label(text.as_bytes()) {
        Ok("PRIVATE KEY") if SigningKey::from_pkcs8_pem(text).is_ok() => {
            format!("this is the secret key, expected the public one, as `openssl pkey -in {shown} -pubout` writes it")
        }
        Ok("PUBLIC KEY") if PublicKey::from_pem(text).is_some() => {
            "this is the public key, expected the secret one that belongs to it".to_owned()
        }
        Ok("ENCRYPTED PRIVATE KEY") => {
            format!("this is a secret key behind a passphrase; `openssl pkey -in {shown}` writes it without one")
        }
        _ => error.to_owned(),
    };
    AcceptError::Key { path: path.to_owned(), message }
}
