//! Which corners of a cell are connected through its inside, for the trilinear interpolant.
//!
//! A plane z = t cuts the cell in a square with bilinear values, whose corners run along the four edges in z. Each region
//! (inside or outside) of such a square holds one of its corners, so what is connected is found by following the planes
//! from t = 0 to 1. Two insides that are neighbours on the square are connected in a face of the cell, which the
//! asymptotic decider has settled. What is left are planes with two insides on one diagonal and two outsides on the
//! other, say A, C and B, D: there the insides are connected where AC > BD, the outsides where AC < BD. Between the events at
//! which an edge in z changes sides the signs are fixed and AC - BD is a quadratic of t, so its signs at both ends and at its
//! extremum say all. This is Chernyaev's interior test for every configuration at once.

/// Corners of the square around, as numbers of the cell's corners at z = 0.
const RING: [usize; 4] = [0, 1, 3, 2];

/// Joins in `region` (the lowest corner of each corner's region) what is connected inside the cell. `d` are the corner
/// values minus the value of the surface; above 0 is inside. Connections within faces are taken as given.
pub fn connect(d: &[f64; 8], region: &mut [u8; 8]) {
    let low = RING.map(|c| d[c]);
    let high = RING.map(|c| d[c + 4]);
    // an edge changes sides at |low| / (|low| + |high|): compared by products, which are exact for 16 bit samples
    let before = |i: usize, j: usize| (low[i] * high[j]).abs() < (low[j] * high[i]).abs();
    let mut events = [0usize; 4];
    let mut count = 0;
    for i in 0..4 {
        if (low[i] > 0.0) != (high[i] > 0.0) {
            let mut k = count;
            while k > 0 && before(i, events[k - 1]) {
                events[k] = events[k - 1];
                k -= 1;
            }
            events[k] = i;
            count += 1;
        }
    }
    // the corner that stands for each edge in z at the plane that we are at
    let mut at = RING;
    let mut start = (0.0, determinant(low));
    let mut done = 0;
    loop {
        let mut next = done;
        let end = if done == count {
            (1.0, determinant(high))
        } else {
            let first = events[done];
            let t = low[first] / (low[first] - high[first]);
            let mut values = plane(&low, &high, t);
            while next < count && !before(first, events[next]) {
                values[events[next]] = 0.0; // by definition, whatever rounding says
                next += 1;
            }
            (t, determinant(values))
        };
        let s = at.map(|c| d[c] > 0.0);
        if s[0] == s[2] && s[1] == s[3] && s[0] != s[1] {
            // corners 0 and 2 of the square are connected where the determinant is above 0, 1 and 3 where it is below
            // if they are the insides; if they are the outsides, both their product and its meaning stay
            let [least, most] = range(&low, &high, start, end);
            if most > 0.0 {
                join(region, at[0], at[2]);
            }
            if least < 0.0 {
                join(region, at[1], at[3]);
            }
        }
        if done == count {
            return;
        }
        for &i in &events[done..next] {
            at[i] += 4;
        }
        done = next;
        start = end;
    }
}

fn plane(low: &[f64; 4], high: &[f64; 4], t: f64) -> [f64; 4] {
    std::array::from_fn(|i| low[i] + t * (high[i] - low[i]))
}

/// AC - BD of a square.
fn determinant(v: [f64; 4]) -> f64 {
    v[0] * v[2] - v[1] * v[3]
}

/// Least and greatest determinant over the planes from `start` to `end`, each (t, determinant there).
fn range(low: &[f64; 4], high: &[f64; 4], start: (f64, f64), end: (f64, f64)) -> [f64; 2] {
    let (mut least, mut most) = (start.1.min(end.1), start.1.max(end.1));
    let t = extremum(low, high);
    if t > start.0 && t < end.0 {
        let q = determinant(plane(low, high, t));
        least = least.min(q);
        most = most.max(q);
    }
    [least, most]
}

/// Where the determinant has its extremum; not finite where it has none.
fn extremum(low: &[f64; 4], high: &[f64; 4]) -> f64 {
    let step: [f64; 4] = std::array::from_fn(|i| high[i] - low[i]);
    let linear = low[0] * step[2] + low[2] * step[0] - low[1] * step[3] - low[3] * step[1];
    -linear / (2.0 * determinant(step))
}

/// Whether Lewiner's code puts a tube between the only two outsides of a cell, at opposite corners, although they are not
/// connected: it does when the extremum along z is not in the cell. See [`super::tables::Entry::outsides_opposed`].
pub fn lewiner_joins_outsides(d: &[f64; 8]) -> bool {
    !(0.0..=1.0).contains(&extremum(&RING.map(|c| d[c]), &RING.map(|c| d[c + 4])))
}

fn join(region: &mut [u8; 8], a: usize, b: usize) {
    let (ra, rb) = (region[a], region[b]);
    for r in region {
        if *r == ra || *r == rb {
            *r = ra.min(rb);
        }
    }
}
