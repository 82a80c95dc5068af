//! Finding the state to go on from among the records that a store holds.

use std::collections::{BTreeMap, BTreeSet};

use super::Record;

/// The key of a record in its job's store: its place first, so that a listing is in order.
pub fn record_key(sequence: u64, name: &str) -> String {
    format!("records/{sequence:010}-{name}")
}

/// The records to replay, oldest first, with their names: as far back as they go without a gap, so that older snapshots can be
/// begun from when a newer one turns out to name what cannot be read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Chain {
    /// `(name, record)`; the first one is a snapshot or record 0.
    pub records: Vec<(String, Record)>,
    /// Places where two records name the same parent.
    pub forks: Vec<Fork>,
}

impl Chain {
    /// Where replaying can begin, the newest place first: snapshots, and the first record of all.
    pub fn starts(&self) -> Vec<usize> {
        let starts = |&i: &usize| i == 0 || self.records[i].1.snapshot.is_some();
        (0..self.records.len()).rev().filter(starts).collect()
    }
}

/// Two or more records with the same parent: two writers were at work.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fork {
    /// The parent.
    pub parent: String,
    /// Its children, the one that was followed first.
    pub children: Vec<String>,
}

/// Why no chain could be followed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChainError {
    /// Records of another image.
    #[error("the store holds another image ({found}, not {wanted}): use another store, or delete it")]
    OtherImage {
        /// What the records say.
        found: String,
        /// What was asked for.
        wanted: String,
    },
    /// There are records, but none leads back to a snapshot or to the start.
    #[error("{records} round record(s), but no complete chain: the newest, {newest}, lacks its ancestors")]
    Incomplete {
        /// How many.
        records: usize,
        /// Name of the newest.
        newest: String,
    },
    /// There are records, and every one of them is broken.
    #[error(
        "{store}: none of its {records} round record(s) can be read: restore them from a copy, or delete the job to start again"
    )]
    Unreadable {
        /// Where.
        store: String,
        /// How many.
        records: usize,
    },
}

/// The newest complete chain: the one that reaches the highest place; of several, the one whose last name is least.
///
/// A chain is complete when it leads back to a record with a snapshot, or to record 0 whose parent is `image`. Records
/// that are missing or were found corrupt are simply not in `records`.
pub fn newest(image: &str, records: BTreeMap<String, Record>) -> Result<Chain, ChainError> {
    let mut children: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (name, record) in &records {
        children.entry(&record.parent).or_default().push(name);
    }
    if let Some(other) = records.values().find(|r| r.image != image) {
        return Err(ChainError::OtherImage { found: other.image.clone(), wanted: image.to_owned() });
    }
    let mut tips: Vec<&String> = records.keys().collect();
    tips.sort_by_key(|name| (std::cmp::Reverse(records[*name].sequence), *name));
    let chain = tips.iter().find_map(|tip| lead_back(image, &records, tip));
    let Some(mut names) = chain else {
        return match tips.first() {
            None => Ok(Chain::default()),
            Some(tip) => Err(ChainError::Incomplete { records: records.len(), newest: (*tip).clone() }),
        };
    };
    names.reverse();
    let followed: BTreeSet<&str> = names.iter().map(String::as_str).collect();
    let forks = children
        .iter()
        .filter(|(_, c)| c.len() > 1)
        .map(|(parent, c)| {
            let mut c: Vec<String> = c.iter().map(|s| (*s).to_owned()).collect();
            c.sort_by_key(|n| (!followed.contains(n.as_str()), n.clone()));
            Fork { parent: (*parent).to_owned(), children: c }
        })
        .collect();
    let mut records = records.clone();
    let records = names.into_iter().filter_map(|n| records.remove(&n).map(|r| (n, r))).collect();
    Ok(Chain { records, forks })
}

/// Names from the tip back to the oldest snapshot, or to the start, that can be reached; none if there is none.
fn lead_back(image: &str, records: &BTreeMap<String, Record>, tip: &str) -> Option<Vec<String>> {
    let mut names = Vec::new();
    let mut complete = 0;
    let mut next = Some(tip);
    let mut after: Option<u64> = None;
    while let Some((name, record)) = next.and_then(|name| Some((name, records.get(name)?)))
        && after.is_none_or(|after| record.sequence.checked_add(1) == Some(after))
    {
        names.push(name.to_owned());
        after = Some(record.sequence);
        let first = record.sequence == 0 && record.parent == image;
        if first || record.snapshot.is_some() {
            complete = names.len();
        }
        next = (!first).then_some(&record.parent);
    }
    names.truncate(complete);
    (complete > 0).then_some(names)
}
