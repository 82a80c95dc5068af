//! One operator at a time: a Lease that is safe whatever the machines' clocks say.
//!
//! Nobody compares times of two machines. Who waits takes the lease when it has seen it unchanged for [`TAKE`] by its own clock; who has
//! it counts from the moment *before* its last write that succeeded, and stops its process when [`HOLD`] has passed. The write was
//! seen after it was sent, so the process has stopped before anybody takes over, as long as two clocks' speeds differ by less than a
//! fifth. Writes name the version that they replace: of two that take, one is refused.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use k8s_openapi::api::coordination::v1::{Lease as LeaseObject, LeaseSpec};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::MicroTime;
use k8s_openapi::jiff::Timestamp;
use kube::api::PostParams;
use kube::{Api, Client};

/// Unchanged for so long: whoever held it has stopped.
pub const TAKE: Duration = Duration::from_secs(15);
/// Without a renewal for so long the holder stops.
pub const HOLD: Duration = Duration::from_secs(10);
/// Between two looks, or renewals.
const LOOK: Duration = Duration::from_secs(2);
/// A renewal that takes longer is tried anew.
const ANSWER: Duration = Duration::from_secs(4);

/// What is known of a lease.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct View {
    /// Who has it; none once it was given back.
    pub holder: Option<String>,
    /// Changes with each write.
    pub version: String,
}

/// What to do about a lease.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Act {
    /// Make it.
    Create,
    /// Write our name into it, over this version of it.
    Write,
    /// Look again later.
    Wait,
}

/// Decides from what one contender has seen, by its own clock.
#[derive(Debug)]
pub struct Election {
    me: String,
    /// The newest version, and when it was first seen.
    seen: Option<(String, Duration)>,
}

impl Election {
    /// For a contender of this name. It must be another after the process that had it could still run.
    pub fn new(me: &str) -> Self {
        Election { me: me.to_owned(), seen: None }
    }

    /// What to do about a lease as it was just read. `now` is any clock that only goes forward.
    pub fn decide(&mut self, lease: Option<&View>, now: Duration) -> Act {
        let Some(lease) = lease else {
            self.seen = None;
            return Act::Create;
        };
        let since = match &self.seen {
            Some((version, since)) if *version == lease.version => *since,
            _ => {
                self.seen = Some((lease.version.clone(), now));
                now
            }
        };
        match &lease.holder {
            Some(holder) if *holder != self.me && now.saturating_sub(since) < TAKE => Act::Wait,
            _ => Act::Write,
        }
    }
}

/// The lease of this process.
pub struct Lease {
    api: Api<LeaseObject>,
    name: String,
    me: String,
    begin: Instant,
    /// Until when it is ours, milliseconds after `begin`; 0 if it is not.
    until: Arc<AtomicU64>,
}

impl Lease {
    /// The lease of this name, not ours yet.
    pub fn new(client: Client, namespace: &str, name: &str, me: &str) -> Self {
        let api = Api::namespaced(client, namespace);
        Lease { api, name: name.into(), me: me.into(), begin: Instant::now(), until: Arc::default() }
    }

    /// Waits until it is ours. From then on the process ends when it is not any more.
    pub async fn acquire(&self) {
        let mut election = Election::new(&self.me);
        let mut told = None;
        loop {
            match tokio::time::timeout(ANSWER, self.step(&mut election)).await {
                Ok(Ok(None)) => break,
                Ok(Ok(holder)) if holder != told => {
                    tracing::info!("waiting: the lease is with {}", holder.clone().unwrap_or_default());
                    told = holder;
                }
                Ok(Ok(_)) => {}
                Ok(Err(e)) => tracing::warn!("lease: {e}"),
                Err(_) => tracing::warn!("lease: the API server does not answer"),
            }
            tokio::time::sleep(LOOK).await;
        }
        tracing::info!(name = self.me, "this operator leads");
    }

    /// One look, and what it asks for. None when the lease is ours, else who has it.
    async fn step(&self, election: &mut Election) -> kube::Result<Option<String>> {
        let found = self.api.get_opt(&self.name).await?;
        let view = found.as_ref().map(|lease| View {
            holder: lease.spec.as_ref().and_then(|s| s.holder_identity.clone()).filter(|h| !h.is_empty()),
            version: lease.metadata.resource_version.clone().unwrap_or_default(),
        });
        // before the write is sent: nobody has seen it earlier
        let sent = self.begin.elapsed();
        let result = match election.decide(view.as_ref(), sent) {
            Act::Wait => return Ok(view.and_then(|v| v.holder)),
            Act::Create => self.api.create(&PostParams::default(), &self.object(None, Some(&self.me))).await,
            Act::Write => {
                self.api.replace(&self.name, &PostParams::default(), &self.object(found.as_ref(), Some(&self.me))).await
            }
        };
        match result {
            Ok(_) => {
                self.until.store((sent + HOLD).as_millis() as u64, Ordering::SeqCst);
                Ok(None)
            }
            // another was faster
            Err(kube::Error::Api(e)) if e.code == 409 => Ok(Some(String::new())),
            Err(e) => Err(e),
        }
    }

    fn object(&self, old: Option<&LeaseObject>, holder: Option<&str>) -> LeaseObject {
        let now = Some(MicroTime(Timestamp::now()));
        let was = old.and_then(|l| l.spec.clone()).unwrap_or_default();
        let same = was.holder_identity.as_deref() == holder;
        // with its version, and whatever others have put there
        let mut metadata = old.map(|l| l.metadata.clone()).unwrap_or_default();
        metadata.name = Some(self.name.clone());
        let spec = LeaseSpec {
            holder_identity: Some(holder.unwrap_or_default().into()),
            lease_duration_seconds: Some(TAKE.as_secs() as i32),
            acquire_time: if same { was.acquire_time } else { now.clone() },
            renew_time: now,
            lease_transitions: Some(was.lease_transitions.unwrap_or(0) + i32::from(!same)),
            ..LeaseSpec::default()
        };
        LeaseObject { metadata, spec: Some(spec) }
    }

    /// Renews it for as long as the process lives.
    pub async fn keep(&self) {
        let mut election = Election::new(&self.me);
        loop {
            tokio::time::sleep(LOOK).await;
            match tokio::time::timeout(ANSWER, self.step(&mut election)).await {
                Ok(Ok(None)) => {}
                // it was taken, or will be: the watching thread ends the process in time
                Ok(Ok(Some(other))) => tracing::warn!("lease: it is with {other}"),
                Ok(Err(e)) => tracing::warn!("lease: {e}"),
                Err(_) => tracing::warn!("lease: the API server does not answer"),
            }
        }
    }

    /// Starts a thread of its own, which no task can hold up, that ends the process when the lease is over.
    ///
    /// # Errors
    /// When there is no thread.
    pub fn watch(&self) -> std::io::Result<()> {
        let (begin, until) = (self.begin, self.until.clone());
        let watch = move || loop {
            std::thread::sleep(Duration::from_millis(200));
            if begin.elapsed().as_millis() as u64 >= until.load(Ordering::SeqCst) {
                tracing::error!("the lease is lost: another operator may go on, so this one ends");
                std::process::exit(1);
            }
        };
        std::thread::Builder::new().name("lease".into()).spawn(watch).map(drop)
    }

    async fn give(&self) -> kube::Result<()> {
        let Some(found) = self.api.get_opt(&self.name).await? else { return Ok(()) };
        if found.spec.as_ref().and_then(|s| s.holder_identity.as_deref()) == Some(&self.me) {
            self.api.replace(&self.name, &PostParams::default(), &self.object(Some(&found), None)).await?;
        }
        Ok(())
    }

    /// Gives it back, so that the next need not wait. Nothing may run any more.
    pub async fn give_back(&self) {
        match tokio::time::timeout(ANSWER, self.give()).await {
            Ok(Ok(())) => {}
            Ok(Err(e)) => tracing::warn!("lease: {e}"),
            Err(_) => tracing::warn!("lease: the API server does not answer"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Small numbers that look random (splitmix64).
    struct Dice(u64);
    impl Dice {
        fn roll(&mut self, sides: u64) -> u64 {
            self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            (z ^ (z >> 31)) % sides
        }
    }

    /// A contender with a clock of its own.
    struct Contender {
        election: Election,
        /// Its clock shows `offset + rate * true time / 1000`.
        offset: u64,
        rate: u64,
        /// When it looks again, true milliseconds.
        wakes: u64,
        /// What it has read, the time it sent its write by its own clock, and when that write arrives.
        writing: Option<(Option<View>, Act, u64, u64)>,
        /// By its own clock.
        until: u64,
    }

    impl Contender {
        fn clock(&self, now: u64) -> u64 {
            self.offset + self.rate * now / 1000
        }
        fn holds(&self, now: u64) -> bool {
            self.clock(now) < self.until
        }
    }

    /// Contenders with skewed clocks over an API server that is slow, fails, and loses answers. Returns how often the lease changed hands.
    fn simulate(seed: u64) -> u64 {
        let mut dice = Dice(seed);
        let mut all: Vec<Contender> = (0..3)
            .map(|n| Contender {
                election: Election::new(&format!("c{n}")),
                offset: dice.roll(1_000_000_000),
                // up to 8 % slow or fast
                rate: 920 + dice.roll(160),
                wakes: dice.roll(4000),
                writing: None,
                until: 0,
            })
            .collect();
        let (mut lease, mut version, mut changes): (Option<View>, u64, u64) = (None, 0, 0);
        // true milliseconds; ten hours would show no more than this does with other seeds
        for now in (0..600_000).step_by(50) {
            let outage = (now / 40_000) % 4 == 3;
            for n in 0..all.len() {
                let c = &mut all[n];
                if let Some((read, act, sent, arrives)) = c.writing.take() {
                    if now < arrives {
                        c.writing = Some((read, act, sent, arrives));
                        continue;
                    }
                    let fresh = lease.as_ref().map(|l| &l.version) == read.as_ref().map(|r| &r.version);
                    if fresh && !outage {
                        version += 1;
                        let me = Some(format!("c{n}"));
                        changes += u64::from(lease.as_ref().is_some_and(|l| l.holder != me));
                        lease = Some(View { holder: me, version: version.to_string() });
                        // the answer may be lost: then it does not know that it has it
                        if dice.roll(10) > 0 {
                            c.until = sent + HOLD.as_millis() as u64;
                        }
                    }
                    c.wakes = now + 2000;
                }
                if now < c.wakes || c.writing.is_some() {
                    continue;
                }
                // a process that is held up now and then
                c.wakes = now + 2000 + if dice.roll(40) == 0 { dice.roll(30_000) } else { 0 };
                if outage {
                    continue;
                }
                let clock = c.clock(now);
                match c.election.decide(lease.as_ref(), Duration::from_millis(clock)) {
                    Act::Wait => {}
                    act => c.writing = Some((lease.clone(), act, clock, now + dice.roll(3000))),
                }
            }
            let holders = all.iter().filter(|c| c.holds(now)).count();
            assert!(holders <= 1, "seed {seed}: {holders} lead at {now} ms");
        }
        changes
    }

    #[test]
    fn never_two_lead_whatever_clocks_and_server_do() {
        let changes: u64 = (0..300).map(simulate).sum();
        assert!(changes > 300, "the lease hardly ever changed hands: {changes}");
    }

    #[test]
    fn a_lease_is_taken_when_it_is_free_ours_or_was_silent_long_enough() {
        let view =
            |holder: Option<&str>, version: &str| View { holder: holder.map(Into::into), version: version.into() };
        let mut me = Election::new("me");
        let at = Duration::from_secs;
        assert_eq!(me.decide(None, at(100)), Act::Create);
        assert_eq!(me.decide(Some(&view(None, "1")), at(100)), Act::Write);
        assert_eq!(me.decide(Some(&view(Some("me"), "1")), at(100)), Act::Write);
        let other = view(Some("other"), "2");
        assert_eq!(me.decide(Some(&other), at(100)), Act::Wait);
        assert_eq!(me.decide(Some(&other), at(114)), Act::Wait);
        assert_eq!(me.decide(Some(&view(Some("other"), "3")), at(115)), Act::Wait, "it was renewed");
        assert_eq!(me.decide(Some(&view(Some("other"), "3")), at(130)), Act::Write);
    }
}
