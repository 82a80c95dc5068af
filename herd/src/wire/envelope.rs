//! The frame around everything that Rayherd itself writes to a store.
//!
//! ```text
//! 0   magic "RHRD"
//! 4   version, kind, compression, 0          u8 each
//! 8   length of the payload uncompressed     u64
//! 16  checksum                               first 16 bytes of blake3 over bytes 0..16 and 32..
//! 32  payload, perhaps compressed (LZ4 block)
//! ```
//!
//! Integers are little endian. The frame itself (magic, places, checksum) is the same in every version, so that a damaged
//! version byte is told from another version: a reader checks magic, then checksum, and only then believes the rest.

use bytes::Bytes;

const MAGIC: [u8; 4] = *b"RHRD";
const VERSION: u8 = 1;
const CHECKED: usize = 16;
const HEADER: usize = 32;
const BYTES: &str = "bytes unpacked";

/// What an envelope holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Kind {
    /// Rays waiting for a split ([`super::ray_group`]).
    RayGroup = 1,
    /// A task's part of the film.
    FilmPart = 2,
    /// What a round consumed and made.
    RoundRecord = 3,
    /// A split's primitives between the worker that cut the scene and the one that builds its block.
    Primitives = 4,
}

/// Whether [`seal`] tries to make a payload smaller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compress {
    /// Stored as it is.
    No,
    /// LZ4, unless that is not smaller.
    Lz4,
}

/// Why bytes could not be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// Not what was written: read another copy, or make it again.
    #[error("corrupt: {0}")]
    Corrupt(String),
    /// Whole, but written by another version of Rayherd: use that one, or make it again.
    #[error("format version {found}, this program reads {VERSION}")]
    Version {
        /// Version of the bytes.
        found: u8,
    },
    /// Whole, but something else.
    #[error("holds kind {found}, expected {expected:?}")]
    Kind {
        /// Kind of the bytes.
        found: u8,
        /// Kind that was asked for.
        expected: Kind,
    },
    /// Whole, but larger than the reader allows.
    #[error("{count} {what}, the limit is {limit}")]
    TooLarge {
        /// Of what.
        what: &'static str,
        /// How many there are.
        count: u64,
        /// How many the reader allows.
        limit: u64,
    },
}

impl WireError {
    /// Corrupt, because of this.
    pub fn corrupt(message: impl Into<String>) -> Self {
        WireError::Corrupt(message.into())
    }
}

/// Frames a payload.
pub fn seal(kind: Kind, payload: &[u8], compress: Compress) -> Bytes {
    let mut out = vec![0; HEADER];
    let mut packed = false;
    if compress == Compress::Lz4 {
        out.resize(HEADER + lz4_flex::block::get_maximum_output_size(payload.len()), 0);
        // fails only for want of room, and there is all that LZ4 may need
        if let Ok(length) = lz4_flex::block::compress_into(payload, &mut out[HEADER..]) {
            packed = length < payload.len();
            out.truncate(HEADER + length);
        }
    }
    if !packed {
        out.truncate(HEADER);
        out.extend_from_slice(payload);
    }
    out[..4].copy_from_slice(&MAGIC);
    out[4..8].copy_from_slice(&[VERSION, kind as u8, u8::from(packed), 0]);
    out[8..CHECKED].copy_from_slice(&(payload.len() as u64).to_le_bytes());
    let sum = checksum(&out);
    out[CHECKED..HEADER].copy_from_slice(&sum);
    out.into()
}

/// Checks a frame and takes the payload out. No more than `limit` bytes are allocated.
pub fn open(kind: Kind, bytes: &[u8], limit: usize) -> Result<Vec<u8>, WireError> {
    if bytes.len() < HEADER {
        return Err(WireError::corrupt(format!("cut off after {} bytes", bytes.len())));
    }
    if bytes[..4] != MAGIC {
        return Err(WireError::corrupt("no Rayherd object (magic number)"));
    }
    if checksum(bytes) != bytes[CHECKED..HEADER] {
        return Err(WireError::corrupt("checksum does not match"));
    }
    let [version, found, compression, reserved] = [bytes[4], bytes[5], bytes[6], bytes[7]];
    if version != VERSION {
        return Err(WireError::Version { found: version });
    }
    if found != kind as u8 {
        return Err(WireError::Kind { found, expected: kind });
    }
    let length = u64::from_le_bytes(std::array::from_fn(|i| bytes[8 + i]));
    if length > limit as u64 {
        return Err(WireError::TooLarge { what: BYTES, count: length, limit: limit as u64 });
    }
    // at most `limit`, which is a usize
    let length = length as usize;
    let stored = &bytes[HEADER..];
    match (compression, reserved) {
        (0, 0) if stored.len() == length => Ok(stored.to_vec()),
        (0, 0) => Err(WireError::corrupt(format!("{} bytes where {length} are announced", stored.len()))),
        (1, 0) => unpack(stored, length),
        _ => Err(WireError::corrupt(format!("unknown compression {compression}, reserved {reserved}"))),
    }
}

fn unpack(stored: &[u8], length: usize) -> Result<Vec<u8>, WireError> {
    // a byte of LZ4 makes at most 255: nothing larger is allocated on the word of a header
    if length / 255 > stored.len() {
        return Err(WireError::corrupt(format!("{} bytes cannot unpack to {length}", stored.len())));
    }
    let mut payload = vec![0; length];
    match lz4_flex::block::decompress_into(stored, &mut payload) {
        Ok(n) if n == length => Ok(payload),
        Ok(n) => Err(WireError::corrupt(format!("unpacks to {n} bytes, not {length}"))),
        Err(e) => Err(WireError::corrupt(format!("does not unpack: {e}"))),
    }
}

fn checksum(bytes: &[u8]) -> [u8; HEADER - CHECKED] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&bytes[..CHECKED]).update(&bytes[HEADER..]);
    let hash = hasher.finalize();
    std::array::from_fn(|i| hash.as_bytes()[i])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rayherd_tests::mutation;

    use super::*;

    fn resealed(mut bytes: Vec<u8>, change: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
        change(&mut bytes);
        let sum = checksum(&bytes);
        bytes[CHECKED..HEADER].copy_from_slice(&sum);
        bytes
    }

    proptest! {
        #[test]
        fn opens_what_was_sealed(payload in prop::collection::vec(0u8..4, 0..2000), lz4: bool) {
            let compress = if lz4 { Compress::Lz4 } else { Compress::No };
            let sealed = seal(Kind::RayGroup, &payload, compress);
            prop_assert!(sealed.len() <= HEADER + payload.len());
            prop_assert_eq!(open(Kind::RayGroup, &sealed, payload.len()).unwrap(), payload);
        }

        #[test]
        fn any_damage_is_corrupt(payload in prop::collection::vec(any::<u8>(), 0..200), at: prop::sample::Index, flip in 1u8..) {
            let mut bytes = seal(Kind::FilmPart, &payload, Compress::Lz4).to_vec();
            let at = at.index(bytes.len());
            bytes[at] ^= flip;
            prop_assert!(matches!(open(Kind::FilmPart, &bytes, 1 << 20), Err(WireError::Corrupt(_))));
            bytes[at] ^= flip;
            bytes.truncate(at);
            prop_assert!(matches!(open(Kind::FilmPart, &bytes, 1 << 20), Err(WireError::Corrupt(_))));
        }

        /// What has a right checksum may still lie: no panic, no allocation beyond the limit.
        #[test]
        fn a_lying_header_is_refused(payload in prop::collection::vec(0u8..2, 0..300), at in 4usize..CHECKED, to: u8) {
            let sealed = seal(Kind::FilmPart, &payload, Compress::Lz4).to_vec();
            let honest = sealed[at] == to;
            let opened = open(Kind::FilmPart, &resealed(sealed, |b| b[at] = to), 1000);
            prop_assert_eq!(opened.is_ok(), honest);
        }

        #[test]
        fn a_lying_body_is_refused(stored in prop::collection::vec(any::<u8>(), 0..100), length in 0u64..1000) {
            let mut bytes = seal(Kind::FilmPart, &stored, Compress::No).to_vec();
            bytes = resealed(bytes, |b| { b[6] = 1; b[8..16].copy_from_slice(&length.to_le_bytes()); });
            if let Ok(payload) = open(Kind::FilmPart, &bytes, 1000) {
                prop_assert_eq!(payload.len() as u64, length);
            }
        }
    }

    /// With the checksum as it was and with a right one: what is opened is what was announced, within the limit.
    #[test]
    fn mutants_are_opened_or_refused() {
        let packed = seal(Kind::RoundRecord, &[b"a record ".as_slice(); 40].concat(), Compress::Lz4).to_vec();
        let plain = seal(Kind::RoundRecord, &[1, 2, 3, 4, 5], Compress::No).to_vec();
        let mut opened = 0;
        let rounds = mutation::rounds("envelope", 20_000, |random| {
            let valid = if random.below(2) == 0 { &packed } else { &plain };
            let mut bytes = mutation::bytes(valid, random);
            if bytes != *valid {
                assert!(open(Kind::RoundRecord, &bytes, 1000).is_err());
            }
            if bytes.len() >= HEADER {
                bytes = resealed(bytes, |_| {});
            }
            if let Ok(payload) = open(Kind::RoundRecord, &bytes, 1000) {
                assert!(
                    payload.len() <= 1000
                        && payload.len() as u64 == u64::from_le_bytes(bytes[8..16].try_into().unwrap())
                );
                opened += 1;
            }
        });
        assert!(rounds.is_none_or(|n| opened > n / 100 && opened < n), "{opened} of {rounds:?}");
    }

    #[test]
    fn names_what_is_wrong() {
        let sealed = seal(Kind::RayGroup, &[7; 100], Compress::Lz4).to_vec();
        assert_eq!(open(Kind::RayGroup, &sealed, 99), Err(WireError::TooLarge { what: BYTES, count: 100, limit: 99 }));
        assert_eq!(open(Kind::FilmPart, &sealed, 100), Err(WireError::Kind { found: 1, expected: Kind::FilmPart }));
        let newer = resealed(sealed.clone(), |b| b[4] = 9);
        assert_eq!(open(Kind::RayGroup, &newer, 100), Err(WireError::Version { found: 9 }));
        let bomb = resealed(sealed, |b| b[8..16].copy_from_slice(&(1u64 << 40).to_le_bytes()));
        assert!(matches!(open(Kind::RayGroup, &bomb, usize::MAX), Err(WireError::Corrupt(_))));
    }
}
