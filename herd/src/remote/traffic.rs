//! What moves while a scene is prepared, by kind and place.

use std::ops::Deref;
use std::sync::{Mutex, PoisonError};

use super::Depot;
use crate::report::{Bytes, Kind, Stage};
use crate::store::{Counters, NodeView, StoreError, Verify};

/// Sums of what was moved and not told of yet.
#[derive(Default)]
pub struct Traffic(Mutex<Bytes>);

/// All stores as one, whose traffic is of one kind. It is added to the sums when this goes.
pub struct Counted<'t> {
    view: NodeView,
    counters: Counters,
    kind: Kind,
    traffic: &'t Traffic,
}

impl Traffic {
    /// All stores, with so many copies of each object; bodies are checked if there is a way to.
    ///
    /// # Errors
    /// When there is no store.
    pub fn stores(
        &self,
        depot: &Depot,
        copies: u32,
        kind: Kind,
        verify: Option<Verify>,
    ) -> Result<Counted<'_>, StoreError> {
        let counters = Counters::new();
        let view = depot.view(copies, verify, Some((counters.clone(), Stage::Prepare)))?;
        Ok(Counted { view, counters, kind, traffic: self })
    }

    /// The sums since they were taken last.
    pub fn take(&self) -> Bytes {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Deref for Counted<'_> {
    type Target = NodeView;
    fn deref(&self) -> &NodeView {
        &self.view
    }
}

impl Drop for Counted<'_> {
    fn drop(&mut self) {
        let mut sums = self.traffic.0.lock().unwrap_or_else(PoisonError::into_inner);
        for row in self.counters.sums().rows() {
            sums.add(row.stage, row.op, self.kind, row.place, row.bytes);
        }
    }
}
