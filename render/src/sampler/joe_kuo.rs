//! Direction numbers of the Sobol sequence.

/// Dimensions of the sequence.
pub const DIMENSIONS: usize = 58;

/// Primitive polynomials (bit i is the coefficient of x^i) and initial direction numbers m_1.. of dimensions 1 to 57, from S. Joe and
/// F. Kuo, "Constructing Sobol sequences with better two-dimensional projections", SIAM J. Sci. Comput. 30 (2008), table
/// new-joe-kuo-6. Dimension 0 is van der Corput's.
#[rustfmt::skip]
const JOE_KUO: [(u32, &[u32]); DIMENSIONS - 1] = [
    (3, &[1]), (7, &[1, 3]), (11, &[1, 3, 1]),
    (13, &[1, 1, 1]), (19, &[1, 1, 3, 3]), (25, &[1, 3, 5, 13]),
    (37, &[1, 1, 5, 5, 17]), (41, &[1, 1, 5, 5, 5]), (47, &[1, 1, 7, 11, 19]),
    (55, &[1, 1, 5, 1, 1]), (59, &[1, 1, 1, 3, 11]), (61, &[1, 3, 5, 5, 31]),
    (67, &[1, 3, 3, 9, 7, 49]), (91, &[1, 1, 1, 15, 21, 21]), (97, &[1, 3, 1, 13, 27, 49]),
    (103, &[1, 1, 1, 15, 7, 5]), (109, &[1, 3, 1, 15, 13, 25]), (115, &[1, 1, 5, 5, 19, 61]),
    (131, &[1, 3, 7, 11, 23, 15, 103]), (137, &[1, 3, 7, 13, 13, 15, 69]), (143, &[1, 1, 3, 13, 7, 35, 63]),
    (145, &[1, 3, 5, 9, 1, 25, 53]), (157, &[1, 3, 1, 13, 9, 35, 107]), (167, &[1, 3, 1, 5, 27, 61, 31]),
    (171, &[1, 1, 5, 11, 19, 41, 61]), (185, &[1, 3, 5, 3, 3, 13, 69]), (191, &[1, 1, 7, 13, 1, 19, 1]),
    (193, &[1, 3, 7, 5, 13, 19, 59]), (203, &[1, 1, 3, 9, 25, 29, 41]), (211, &[1, 3, 5, 13, 23, 1, 55]),
    (213, &[1, 3, 7, 3, 13, 59, 17]), (229, &[1, 3, 1, 3, 5, 53, 69]), (239, &[1, 1, 5, 5, 23, 33, 13]),
    (241, &[1, 1, 7, 7, 1, 61, 123]), (247, &[1, 1, 7, 9, 13, 61, 49]), (253, &[1, 3, 3, 5, 3, 55, 33]),
    (285, &[1, 3, 1, 15, 31, 13, 49, 245]), (299, &[1, 3, 5, 15, 31, 59, 63, 97]), (301, &[1, 3, 1, 11, 11, 11, 77, 249]),
    (333, &[1, 3, 1, 11, 27, 43, 71, 9]), (351, &[1, 1, 7, 15, 21, 11, 81, 45]), (355, &[1, 3, 7, 3, 25, 31, 65, 79]),
    (357, &[1, 3, 1, 1, 19, 11, 3, 205]), (361, &[1, 1, 5, 9, 19, 21, 29, 157]), (369, &[1, 3, 7, 11, 1, 33, 89, 185]),
    (391, &[1, 3, 3, 3, 15, 9, 79, 71]), (397, &[1, 3, 7, 11, 15, 39, 119, 27]), (425, &[1, 1, 3, 1, 11, 31, 97, 225]),
    (451, &[1, 1, 1, 3, 23, 43, 57, 177]), (463, &[1, 3, 7, 7, 17, 17, 37, 71]), (487, &[1, 3, 1, 5, 27, 63, 123, 213]),
    (501, &[1, 1, 3, 5, 11, 43, 53, 133]), (529, &[1, 3, 5, 5, 29, 17, 47, 173, 479]), (539, &[1, 3, 3, 11, 3, 1, 109, 9, 69]),
    (545, &[1, 1, 1, 5, 17, 39, 23, 5, 343]), (557, &[1, 3, 1, 5, 25, 15, 31, 103, 499]), (563, &[1, 1, 1, 11, 11, 17, 63, 105, 183]),
];

/// Row `d`, column `k`: what bit `k` of the index adds (by xor) to dimension `d`, as a binary fraction with its first bit on top.
pub const MATRICES: [[u32; 32]; DIMENSIONS] = matrices();

const fn matrices() -> [[u32; 32]; DIMENSIONS] {
    let mut out = [[0; 32]; DIMENSIONS];
    let mut k = 0;
    while k < 32 {
        out[0][k] = 1 << (31 - k);
        k += 1;
    }
    let mut d = 1;
    while d < DIMENSIONS {
        let (polynomial, initial) = JOE_KUO[d - 1];
        let degree = initial.len();
        let mut k = 0;
        while k < 32 {
            out[d][k] = if k < degree {
                initial[k] << (31 - k)
            } else {
                let mut v = out[d][k - degree] ^ (out[d][k - degree] >> degree);
                let mut i = 1;
                while i < degree {
                    if polynomial >> (degree - i) & 1 == 1 {
                        v ^= out[d][k - i];
                    }
                    i += 1;
                }
                v
            };
            k += 1;
        }
        d += 1;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The matrices are those of an independent implementation (SciPy 1.16's `qmc.Sobol`, 32 bits): FNV-1a over the words.
    #[test]
    fn known_matrices() {
        let hash = MATRICES
            .iter()
            .flatten()
            .fold(0xcbf2_9ce4_8422_2325_u64, |h, &w| (h ^ u64::from(w)).wrapping_mul(0x0000_0100_0000_01b3));
        assert_eq!(hash, 0x9858_2b81_f5c2_18db);
        assert_eq!(MATRICES[57][3], 0xb000_0000);
        assert_eq!(MATRICES[57][31], 0xc5fc_1bfb);
    }
}
