//! The shape of each primitive of a split, in little memory and few steps.

use rayherd_render::memory::prefetch;

/// Most parts of a guide, within the room that [`crate::resident::top_bytes`] leaves beside a block's trees.
const MOST_PARTS: usize = 1024;

/// Shapes by primitive: by runs, whose tables stay in near caches where a number each misses the last one at each hit; or a number each
/// when these are fewer bytes.
pub(crate) enum Shapes {
    /// One by one.
    Each(Vec<u32>),
    /// By runs.
    Runs(Runs),
}

pub(crate) struct Runs {
    /// First primitive of each run but the first.
    starts: Vec<u32>,
    /// Shape of each run.
    shapes: Vec<u32>,
    /// For each of equal parts of the primitives how many runs end before it, and one more: so that a search takes a step or two.
    guide: Vec<u32>,
    /// Primitives of a part, as a shift.
    shift: u32,
}

impl Shapes {
    pub(crate) fn new(each: Vec<u32>) -> Shapes {
        let count = each.chunk_by(|a, b| a == b).count();
        // two numbers a run, and a part of the guide for four primitives
        if 2 * count + each.len().div_ceil(4) >= each.len() {
            return Shapes::Each(each);
        }
        let (mut starts, mut shapes) = (Vec::with_capacity(count.saturating_sub(1)), Vec::with_capacity(count));
        let mut at = 0;
        for run in each.chunk_by(|a, b| a == b) {
            shapes.push(run[0]);
            at += run.len();
            if at < each.len() {
                starts.push(at as u32);
            }
        }
        // about two parts to a run; of four primitives at least
        let parts = (2 * count).clamp(1, MOST_PARTS);
        let shift = each.len().div_ceil(parts).max(4).next_power_of_two().trailing_zeros();
        let part = |k: usize| starts.partition_point(|&start| start as usize <= k << shift) as u32;
        let guide = (0..=each.len().div_ceil(1 << shift)).map(part).collect();
        Shapes::Runs(Runs { starts, shapes, guide, shift })
    }

    #[inline(always)]
    pub(crate) fn get(&self, primitive: usize) -> u32 {
        match self {
            Shapes::Each(shapes) => shapes[primitive],
            Shapes::Runs(Runs { starts, shapes, guide, shift }) => {
                let part = primitive >> shift;
                let (first, last) = (guide[part] as usize, guide[part + 1] as usize);
                let run = first + starts[first..last].partition_point(|&start| start as usize <= primitive);
                shapes[run]
            }
        }
    }

    /// Asks for what [`Shapes::get`] reads, where that may be far.
    #[inline(always)]
    pub(crate) fn foresee(&self, primitive: usize) {
        if let Shapes::Each(shapes) = self
            && let Some(shape) = shapes.get(primitive)
        {
            prefetch(shape);
        }
    }

    pub(crate) fn bytes(&self) -> usize {
        4 * match self {
            Shapes::Each(shapes) => shapes.capacity(),
            Shapes::Runs(runs) => runs.starts.capacity() + runs.shapes.capacity() + runs.guide.capacity(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_primitive_has_its_shape_and_no_more_memory_is_taken() {
        let runs = |runs: usize, length: usize| (0..runs * length).map(|i| (i / length % 7) as u32).collect::<Vec<_>>();
        // runs of very different length: many of one part, many parts of one
        let uneven: Vec<u32> = (0..600).flat_map(|i| vec![i % 5; if i % 100 == 0 { 5000 } else { 4 }]).collect();
        let kinds = [
            vec![],
            vec![5],
            vec![1, 1, 2],
            runs(3, 3),
            runs(256, 3),
            runs(257, 1),
            runs(1000, 2),
            runs(1000, 9),
            uneven,
        ];
        for each in kinds {
            let shapes = Shapes::new(each.clone());
            for (i, shape) in each.iter().enumerate() {
                shapes.foresee(i);
                assert_eq!(shapes.get(i), *shape, "{i} of {}", each.len());
            }
            assert!(shapes.bytes() <= 4 * each.len(), "{} bytes for {}", shapes.bytes(), each.len());
        }
    }
}
