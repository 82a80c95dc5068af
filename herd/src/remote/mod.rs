//! A job on machines of their own: what operator and worker say to each other, and what each does about it.
//!
//! The operator plans and commits; it never reads rays or film. A worker asks for work ([`Poll`]), does it next to its own
//! store ([`station`]) and reports ids and counts ([`Report`]). [`fleet::Fleet`] is the operator's side: the executor of the
//! loop over rounds ([`crate::driver`]), fed by workers that come and go. How messages travel is not known here.

pub mod bands;
mod blocks;
mod deaths;
pub mod depot;
pub mod fleet;
pub mod frames;
mod guard;
mod holdings;
mod homes;
mod listing;
pub mod message;
mod parts;
mod prepare;
pub mod preparing;
pub mod profile;
pub mod station;
pub mod storage;
#[cfg(test)]
mod tests;
mod traffic;
pub mod turns;

pub use depot::Depot;
pub use fleet::Fleet;
pub use message::{Answer, Beat, Failure, Poll, Report, Stage, Work, WorkerId};
pub use prepare::download;
pub use profile::{Profile, Service};
pub use station::{Link, LinkError, Station};
pub use storage::{Endpoint, Storage};
pub use turns::Turns;
