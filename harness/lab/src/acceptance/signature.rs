//! Signs the manifest (ed25519, 64 raw bytes in `manifest.sha256.sig`) and checks the signature.
//! Keys have the PEM formats of OpenSSL: PKCS #8 and SPKI. `openssl pkeyutl -verify -rawin` also
//! checks a signature.

use crate::acceptance::error::AcceptError;
use ed25519_dalek::pkcs8::spki::der::pem::{LineEnding, decode_label};
use ed25519_dalek::pkcs8::{DecodePrivateKey, DecodePublicKey, EncodePublicKey};
use ed25519_dalek::{Signature, Signer as _, SigningKey, VerifyingKey};
use platebench_model::record::sha256;
use platebench_model::trace::{AtPath, read_text_file};
use std::path::Path;

pub const FILE: &str = "manifest.sha256.sig";
/// Largest file of a key. A PEM of ed25519 has about 120 bytes.
const MAX_KEY_BYTES: u64 = 64 << 10;

#[derive(Clone)]
pub struct SecretKey(SigningKey);

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublicKey(VerifyingKey);

impl SecretKey {
    pub fn read(path: &Path) -> Result<Self, AcceptError> {
        let text = read_text_file(path, MAX_KEY_BYTES).at(path)?;
        SigningKey::from_pkcs8_pem(&text).map(Self).map_err(|error| key_error(path, &text, &error.to_string()))
    }

    pub fn public_key(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }

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
    pub fn read(path: &Path) -> Result<Self, AcceptError> {
        let text = read_text_file(path, MAX_KEY_BYTES).at(path)?;
        VerifyingKey::from_public_key_pem(&text).map(Self).map_err(|error| key_error(path, &text, &error.to_string()))
    }

    pub(crate) fn from_pem(text: &str) -> Option<Self> {
        VerifyingKey::from_public_key_pem(text).ok().map(Self)
    }

    pub(crate) fn to_pem(&self) -> String {
        self.0.to_public_key_pem(LineEnding::LF).unwrap_or_default()
    }

    /// Returns the SHA-256 of the 32 bytes of the key, hexadecimal.
    pub fn fingerprint(&self) -> String {
        sha256(self.0.as_bytes())
    }

    /// Rejects weak keys, because one signature of a weak key is valid for many messages.
    pub(crate) fn verifies(&self, content: &[u8], signature: &[u8]) -> bool {
        Signature::from_slice(signature).is_ok_and(|signature| self.0.verify_strict(content, &signature).is_ok())
    }
}

fn key_error(path: &Path, text: &str, error: &str) -> AcceptError {
    let path_text = path.display();
    let message = match decode_label(text.as_bytes()) {
        Ok("PRIVATE KEY") if SigningKey::from_pkcs8_pem(text).is_ok() => {
            format!(
                "this is the secret key, expected the public key, as `openssl pkey -in {path_text} -pubout` writes it"
            )
        }
        Ok("PUBLIC KEY") if PublicKey::from_pem(text).is_some() => {
            "this is the public key, expected the secret key".to_owned()
        }
        Ok("ENCRYPTED PRIVATE KEY") => {
            format!("this secret key has a passphrase, expected one without; `openssl pkey -in {path_text}` removes it")
        }
        _ => error.to_owned(),
    };
    AcceptError::Key { path: path.to_owned(), message }
}
