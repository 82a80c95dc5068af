//! Shading attributes of a split's primitives, an object beside its geometry.
//!
//! Layout, little endian: `RHA1`, flags u32 (1: normals, 2: texture coordinates, 4: the mesh's attribute), number of primitives u32, number of runs u32, then the runs
//! (length u32, shape u32; neighbours differ), then 9 f32 of normals per primitive, then 6 f32 of texture coordinates per
//! primitive, then 9 f32 of the attribute per primitive. A primitive without normals or attribute has nine zeros.

use crate::memory::spacious;

const MAGIC: &[u8; 4] = b"RHA1";
const HEADER: usize = 16;

/// Attributes of a split's primitives, by local index.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AttributeBlock {
    /// Shape number of each primitive.
    pub shapes: Vec<u32>,
    /// Shading normals of the three vertices of each primitive, or empty when none has any. Zeros: this one has none.
    pub normals: Vec<[[f32; 3]; 3]>,
    /// Texture coordinates of the three vertices of each primitive, or empty when none has any. NaN ([`NO_UV`]): this one has none, whatever the
    /// others beside it have, so that how a scene is cut shows nowhere.
    pub uvs: Vec<[[f32; 2]; 3]>,
    /// The mesh's attribute at the three vertices of each primitive, or empty when none has any.
    pub attributes: Vec<[[f32; 3]; 3]>,
}

/// Texture coordinates of a primitive that has none among some that have; zeros would be coordinates.
pub const NO_UV: [[f32; 2]; 3] = [[f32::NAN; 2]; 3];

/// Why bytes are no attribute block.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AttributeError {
    /// Not this format, or another version of it.
    #[error("this is no attribute block of version 1")]
    Magic,
    /// Flags of a later version.
    #[error("unknown flags {0:#x}")]
    Flags(u32),
    /// The header asks for another length.
    #[error("the header says {expected} bytes, there are {found}")]
    Length {
        /// By the header.
        expected: u64,
        /// Really.
        found: u64,
    },
    /// The runs do not add up to the number of primitives.
    #[error("the runs have {found} primitives instead of {expected}")]
    Runs {
        /// By the header.
        expected: u32,
        /// Sum of the runs.
        found: u64,
    },
}

impl AttributeBlock {
    /// Texture coordinates of a primitive, if it has any.
    #[inline(always)]
    pub fn uv(&self, local: usize) -> Option<[[f32; 2]; 3]> {
        self.uvs.get(local).copied().filter(|uv| !uv[0][0].is_nan())
    }

    /// The block as bytes.
    ///
    /// # Panics
    /// When `normals`, `uvs` or `attributes` is neither empty nor as long as `shapes`: a mistake of the caller.
    pub fn encode(&self) -> Vec<u8> {
        let n = self.shapes.len();
        assert!(self.normals.is_empty() || self.normals.len() == n, "normals for each primitive or none");
        assert!(self.uvs.is_empty() || self.uvs.len() == n, "texture coordinates for each primitive or none");
        assert!(self.attributes.is_empty() || self.attributes.len() == n, "an attribute for each primitive or none");
        let runs: Vec<[u32; 2]> = self.shapes.chunk_by(|a, b| a == b).map(|run| [run.len() as u32, run[0]]).collect();
        let flags = u32::from(!self.normals.is_empty())
            | u32::from(!self.uvs.is_empty()) << 1
            | u32::from(!self.attributes.is_empty()) << 2;
        let floats = 36 * self.normals.len() + 24 * self.uvs.len() + 36 * self.attributes.len();
        let mut out = Vec::with_capacity(HEADER + 8 * runs.len() + floats);
        out.extend(MAGIC);
        for word in [flags, n as u32, runs.len() as u32] {
            out.extend(word.to_le_bytes());
        }
        for word in runs.as_flattened() {
            out.extend(word.to_le_bytes());
        }
        let [normals, uvs] = [self.normals.as_flattened().as_flattened(), self.uvs.as_flattened().as_flattened()];
        for x in normals.iter().chain(uvs).chain(self.attributes.as_flattened().as_flattened()) {
            out.extend(x.to_le_bytes());
        }
        out
    }

    /// From bytes. Takes memory for what the bytes hold and for `shapes`, whose number is checked against `primitives`, that of the
    /// geometry beside it.
    pub fn decode(bytes: &[u8], primitives: u32) -> Result<AttributeBlock, AttributeError> {
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        if bytes.len() < HEADER || &bytes[..4] != MAGIC {
            return Err(AttributeError::Magic);
        }
        let [flags, n, runs] = [word(4), word(8), word(12)];
        if flags > 7 {
            return Err(AttributeError::Flags(flags));
        }
        if n != primitives {
            return Err(AttributeError::Runs { expected: primitives, found: u64::from(n) });
        }
        let normals = if flags & 1 != 0 { n as usize } else { 0 };
        let uvs = if flags & 2 != 0 { n as usize } else { 0 };
        let attributes = if flags & 4 != 0 { n as usize } else { 0 };
        // each factor is below 2^32 and the sizes below 2^6: no overflow in 64 bits
        let expected = HEADER as u64 + 8 * u64::from(runs) + 36 * (normals + attributes) as u64 + 24 * uvs as u64;
        if expected != bytes.len() as u64 {
            return Err(AttributeError::Length { expected, found: bytes.len() as u64 });
        }
        let runs_end = HEADER + 8 * runs as usize;
        let pairs = || (HEADER..runs_end).step_by(8).map(|at| (word(at), word(at + 4)));
        let found = pairs().map(|(length, _)| u64::from(length)).sum();
        if found != u64::from(n) {
            return Err(AttributeError::Runs { expected: n, found });
        }
        let mut shapes = Vec::with_capacity(n as usize);
        for (length, shape) in pairs() {
            shapes.resize(shapes.len() + length as usize, shape);
        }
        let floats = |at: usize| f32::from_bits(word(at));
        let normals_end = runs_end + 36 * normals;
        let uvs_end = normals_end + 24 * uvs;
        let threes = |at: usize| std::array::from_fn(|v| std::array::from_fn(|c| floats(at + 12 * v + 4 * c)));
        let twos = |at: usize| std::array::from_fn(|v| std::array::from_fn(|c| floats(at + 8 * v + 4 * c)));
        // read here and there
        let mut block =
            AttributeBlock { shapes, normals: spacious(normals), uvs: spacious(uvs), attributes: spacious(attributes) };
        block.normals.extend((runs_end..normals_end).step_by(36).map(threes));
        block.uvs.extend((normals_end..uvs_end).step_by(24).map(twos));
        block.attributes.extend((uvs_end..bytes.len()).step_by(36).map(threes));
        Ok(block)
    }
}

#[cfg(test)]
mod tests {
    use rayherd_tests::mutation;

    use super::*;
    use crate::testing::Rng;

    fn block(n: usize, normals: bool, uvs: bool, attributes: bool) -> AttributeBlock {
        let mut rng = Rng(1);
        AttributeBlock {
            shapes: (0..n).map(|i| [3, 3, 7, 9][i * 4 / n.max(1)]).collect(),
            normals: if normals { (0..n).map(|_| [rng.direction().to_array(); 3]).collect() } else { Vec::new() },
            uvs: if uvs { (0..n).map(|_| [[rng.f32(), rng.f32()]; 3]).collect() } else { Vec::new() },
            attributes: if attributes { (0..n).map(|_| [[rng.f32(); 3]; 3]).collect() } else { Vec::new() },
        }
    }

    #[test]
    fn bytes_come_back() {
        for n in [0, 1, 1000] {
            for has in 0..8 {
                let block = block(n, has & 1 != 0, has & 2 != 0, has & 4 != 0);
                assert_eq!(AttributeBlock::decode(&block.encode(), n as u32), Ok(block));
            }
        }
        // one run for equal neighbours
        assert_eq!(block(1000, false, false, false).encode().len(), 16 + 3 * 8);
    }

    #[test]
    fn bad_bytes_are_refused() {
        let good = block(20, true, true, true).encode();
        for n in 0..good.len() {
            assert!(AttributeBlock::decode(&good[..n], 20).is_err());
        }
        assert!(AttributeBlock::decode(&good, 21).is_err());
        let mut refused = 0;
        let rounds = mutation::rounds("attributes", 20_000, |random| {
            // mostly in the header and the runs
            let bad = match random.below(2) {
                0 => mutation::bytes(&good, random),
                _ => [mutation::bytes(&good[..48], random), good[48..].to_vec()].concat(),
            };
            match AttributeBlock::decode(&bad, 20) {
                Ok(block) => {
                    assert_eq!(block.shapes.len(), 20);
                    let lengths = [block.normals.len(), block.uvs.len(), block.attributes.len()];
                    assert!(lengths.iter().all(|n| [0, 20].contains(n)));
                }
                Err(_) => refused += 1,
            }
        });
        assert!(rounds.is_none_or(|n| refused > n / 4 && refused < n), "{refused} of {rounds:?}");
        // a header that asks for the most: refused before memory is taken
        let mut huge = good[..16].to_vec();
        huge[4..16].fill(0xff);
        huge[4] = 7;
        huge[5..8].fill(0);
        assert!(matches!(AttributeBlock::decode(&huge, u32::MAX), Err(AttributeError::Length { .. })));
    }
}
