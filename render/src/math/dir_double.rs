//! Directions of the build in f64, in which none travels: as they are.

/// A unit vector.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UnitDir([f64; 3]);

impl UnitDir {
    /// Of a vector that is not 0.
    #[inline]
    pub fn encode(v: [f64; 3]) -> UnitDir {
        let scale = 1.0 / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        UnitDir(v.map(|x| x * scale))
    }

    /// The direction.
    #[inline]
    pub fn decode(self) -> [f64; 3] {
        self.0
    }
}
