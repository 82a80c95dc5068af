//! The global ids of a block's primitives, by local index, in little space.
//!
//! Ids ascend within the triangles and within the spheres of a block; splits in source order have long runs of
//! consecutive ids. Stored in the smaller of two ways:
//! *runs*: n times (u64 first id, u32 first local index, u32 zero), ascending in the index, the first at index 0;
//! *plain*: one u64 for each primitive.

use super::layout::{read_u32, read_u64};
use crate::ray::PrimId;

/// Ids by local index.
#[derive(Debug)]
pub(super) enum Ids {
    /// First id and first local index of each run.
    Runs(Vec<(PrimId, u32)>),
    /// Each id.
    Plain(Vec<PrimId>),
}

/// Header's name for runs, and for plain ids.
const RUNS: u32 = 0;
const PLAIN: u32 = 1;
/// Bytes of a run.
const RUN_BYTES: usize = 16;

impl Ids {
    /// From the ids in local order.
    pub fn new(ids: impl Iterator<Item = PrimId> + Clone) -> Ids {
        let mut runs: Vec<(PrimId, u32)> = Vec::new();
        let mut previous = None;
        for (local, id) in ids.clone().enumerate() {
            if previous.and_then(|p: PrimId| p.checked_add(1)) != Some(id) {
                runs.push((id, local as u32));
            }
            previous = Some(id);
        }
        if runs.len() * RUN_BYTES <= ids.clone().count() * 8 { Ids::Runs(runs) } else { Ids::Plain(ids.collect()) }
    }

    /// Id of a primitive; `local` is below the count that the ids were made for.
    pub fn get(&self, local: u32) -> PrimId {
        match self {
            Ids::Plain(ids) => ids[local as usize],
            Ids::Runs(runs) => {
                let (first, at) = runs[runs.partition_point(|r| r.1 <= local) - 1];
                // wrapping: a run in untrusted bytes may pass the end of the numbers
                first.wrapping_add(u64::from(local - at))
            }
        }
    }

    /// The header's name for this way.
    pub fn coding(&self) -> u32 {
        match self {
            Ids::Runs(_) => RUNS,
            Ids::Plain(_) => PLAIN,
        }
    }
    /// Appends the bytes.
    pub fn write(&self, out: &mut Vec<u8>) {
        match self {
            Ids::Plain(ids) => ids.iter().for_each(|id| out.extend(id.to_le_bytes())),
            Ids::Runs(runs) => {
                for &(id, at) in runs {
                    out.extend(id.to_le_bytes());
                    out.extend(at.to_le_bytes());
                    out.extend([0; 4]);
                }
            }
        }
    }
    /// Reads and checks the ids of a block: what is wrong.
    pub fn read(coding: u32, bytes: &[u8], triangles: u32, spheres: u32) -> Result<Ids, &'static str> {
        let count = triangles as usize + spheres as usize;
        match coding {
            PLAIN => {
                if bytes.len() != count * 8 {
                    return Err("there are not as many ids as primitives");
                }
                let ids: Vec<PrimId> = (0..count).map(|i| read_u64(bytes, i * 8)).collect();
                let (t, s) = ids.split_at(triangles as usize);
                let ascends = |part: &[PrimId]| part.windows(2).all(|w| w[0] < w[1]);
                if ascends(t) && ascends(s) { Ok(Ids::Plain(ids)) } else { Err("the ids do not ascend") }
            }
            RUNS => {
                if !bytes.len().is_multiple_of(RUN_BYTES) {
                    return Err("the runs of ids are cut");
                }
                if bytes.chunks_exact(RUN_BYTES).any(|r| read_u32(r, 12) != 0) {
                    return Err("a reserved field of the runs of ids is set");
                }
                let runs: Vec<(PrimId, u32)> =
                    bytes.chunks_exact(RUN_BYTES).map(|r| (read_u64(r, 0), read_u32(r, 8))).collect();
                if runs.first().is_some_and(|r| r.1 != 0) || runs.is_empty() != (count == 0) {
                    return Err("the runs of ids do not begin with the first primitive");
                }
                for (i, &(first, at)) in runs.iter().enumerate() {
                    let end = runs.get(i + 1).map_or(count as u64, |r| u64::from(r.1));
                    if end <= u64::from(at) || end > count as u64 {
                        return Err("the runs of ids are empty or pass the last primitive");
                    }
                    let Some(last) = first.checked_add(end - u64::from(at) - 1) else {
                        return Err("a run of ids passes the largest id");
                    };
                    if end as usize != triangles as usize && runs.get(i + 1).is_some_and(|r| r.0 <= last) {
                        return Err("the ids do not ascend");
                    }
                }
                Ok(Ids::Runs(runs))
            }
            _ => Err("the coding of ids is unknown"),
        }
    }
    /// Memory taken, bytes.
    pub fn memory(&self) -> usize {
        match self {
            Ids::Runs(runs) => runs.len() * size_of::<(PrimId, u32)>(),
            Ids::Plain(ids) => ids.len() * 8,
        }
    }
}
