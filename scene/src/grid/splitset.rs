//! A set of splits, one bit each.

/// A set of split indices.
#[derive(Clone, Debug, Default)]
pub struct SplitSet {
    words: Vec<u64>,
}

impl SplitSet {
    /// An empty set with room for `splits` indices.
    pub fn with_capacity(splits: u32) -> Self {
        SplitSet { words: Vec::with_capacity(splits.div_ceil(64) as usize) }
    }

    /// Adds a split; adding it again changes nothing.
    pub fn insert(&mut self, split: u32) {
        let word = (split / 64) as usize;
        if word >= self.words.len() {
            self.words.resize(word + 1, 0);
        }
        self.words[word] |= 1 << (split % 64);
    }

    /// Whether a split is in it.
    #[inline]
    pub fn contains(&self, split: u32) -> bool {
        self.words.get((split / 64) as usize).is_some_and(|w| w >> (split % 64) & 1 == 1)
    }

    /// Whether all of it is in `other`.
    pub fn is_subset(&self, other: &SplitSet) -> bool {
        self.words.iter().enumerate().all(|(i, w)| w & !other.words.get(i).copied().unwrap_or(0) == 0)
    }

    /// Number of splits in it.
    pub fn len(&self) -> u32 {
        self.words.iter().map(|w| w.count_ones()).sum()
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.words.iter().all(|&w| w == 0)
    }

    /// The splits, ascending.
    pub fn iter(&self) -> impl Iterator<Item = u32> + '_ {
        self.words.iter().enumerate().flat_map(|(i, &word)| {
            let mut rest = word;
            std::iter::from_fn(move || {
                if rest == 0 {
                    return None;
                }
                let bit = rest.trailing_zeros();
                rest &= rest - 1;
                Some(i as u32 * 64 + bit)
            })
        })
    }
}

impl PartialEq for SplitSet {
    fn eq(&self, other: &Self) -> bool {
        self.is_subset(other) && other.is_subset(self)
    }
}

impl Eq for SplitSet {}

impl FromIterator<u32> for SplitSet {
    fn from_iter<I: IntoIterator<Item = u32>>(splits: I) -> Self {
        let mut set = SplitSet::default();
        splits.into_iter().for_each(|s| set.insert(s));
        set
    }
}
