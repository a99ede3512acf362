//! The secret that requests must bring where other users share the machine: 256 random bits in a file that only this user can read.

use crate::atomic_file::write_atomically;
use base64::{Engine, prelude::BASE64_STANDARD};
use std::{
    fmt,
    fs::{self, File, Permissions},
    io::{self, Read, Write},
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
};

/// The file in the data directory.
pub const TOKEN_NAME: &str = "token";

/// Why the token cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The file holds something else.
    #[error("{} holds no token, which is 64 hexadecimal digits; remove the file to have a new one made", .0.display())]
    Malformed(PathBuf),
    /// The system refuses.
    #[error("cannot use {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// The token. It is neither printed nor logged.
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

impl Token {
    /// Reads the token of a data directory, or makes one.
    ///
    /// # Errors
    /// If the system refuses, or the file holds something else.
    pub fn of_folder(root: &Path) -> Result<Self, TokenError> {
        let path = root.join(TOKEN_NAME);
        let token = match Self::read(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Self::make(&path).map(Some),
            read => read,
        };
        match token {
            Ok(Some(token)) => Ok(token),
            Ok(None) => Err(TokenError::Malformed(path)),
            Err(source) => Err(TokenError::Io { path, source }),
        }
    }

    /// The token in a file; `None` if it holds something else.
    fn read(path: &Path) -> io::Result<Option<Self>> {
        let bytes = fs::read(path)?;
        // Somebody may have copied the file about: what others can read is no secret.
        fs::set_permissions(path, Permissions::from_mode(0o600))?;
        Ok(std::str::from_utf8(&bytes).ok().and_then(Self::parse))
    }

    fn parse(text: &str) -> Option<Self> {
        let text = text.trim();
        let is_token = text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        is_token.then(|| Token(text.to_owned()))
    }

    fn make(path: &Path) -> io::Result<Self> {
        let mut bits = [0; 32];
        File::open("/dev/urandom")?.read_exact(&mut bits)?;
        let token: String = bits.iter().map(|byte| format!("{byte:02x}")).collect();
        write_atomically(path, |file| {
            file.get_ref()
                .set_permissions(Permissions::from_mode(0o600))?;
            writeln!(file, "{token}")
        })?;
        Ok(Token(token))
    }

    /// Whether an `Authorization` header brings it: as `Bearer`, or as the password of `Basic`, which browsers ask for.
    pub fn is_in(&self, authorization: &[u8]) -> bool {
        let Ok(text) = std::str::from_utf8(authorization) else {
            return false;
        };
        match text.split_once(' ') {
            Some((scheme, token)) if scheme.eq_ignore_ascii_case("bearer") => {
                self.equals(token.trim().as_bytes())
            }
            Some((scheme, credentials)) if scheme.eq_ignore_ascii_case("basic") => {
                let decoded = BASE64_STANDARD.decode(credentials.trim());
                let decoded = decoded.unwrap_or_default();
                let colon = decoded.iter().position(|byte| *byte == b':');
                colon.is_some_and(|colon| self.equals(&decoded[colon + 1..]))
            }
            _ => false,
        }
    }

    /// Compares in a time that depends on the lengths alone.
    fn equals(&self, other: &[u8]) -> bool {
        let own = self.0.as_bytes();
        let pairs = own.iter().zip(other);
        own.len() == other.len() && pairs.fold(0, |bits, (a, b)| bits | (a ^ b)) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_made_once_and_for_its_owner_alone() {
        let folder = tempfile::tempdir().unwrap();
        let made = Token::of_folder(folder.path()).unwrap();
        let path = folder.path().join(TOKEN_NAME);
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        fs::set_permissions(&path, Permissions::from_mode(0o644)).unwrap();
        let read = Token::of_folder(folder.path()).unwrap();
        assert_eq!(read.0, made.0);
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        fs::write(&path, "short").unwrap();
        let error = Token::of_folder(folder.path()).unwrap_err();
        assert!(matches!(error, TokenError::Malformed(_)), "{error}");
        assert!(error.to_string().contains(path.to_str().unwrap()));
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        let error = Token::of_folder(folder.path()).unwrap_err();
        assert!(matches!(error, TokenError::Io { .. }), "{error}");
    }

    #[test]
    fn a_token_is_brought_in_two_ways() {
        let token = Token::parse(&"a7".repeat(32)).unwrap();
        let basic = BASE64_STANDARD.encode(format!("me:{}", token.0));
        assert!(token.is_in(format!("Bearer {}", token.0).as_bytes()));
        assert!(token.is_in(format!("Basic {basic}").as_bytes()));
        for wrong in ["", "Bearer", "Bearer a7", "Basic YTpi", "Basic !!!"] {
            assert!(!token.is_in(wrong.as_bytes()), "{wrong}");
        }
        let other = format!("Bearer {}", "a8".repeat(32));
        assert!(!token.is_in(other.as_bytes()));
    }
}
