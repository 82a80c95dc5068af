//! Stores by address: a folder, or `s3://bucket/prefix`.
//!
//! A store holds prepared scenes (`objects/`, `names/`) and, per picture, the commits of its job (`jobs/PICTURE/`) with a note of what
//! it is.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use anyhow::Context;
use clap::Args;
use rayherd_api::ByteSize;
use rayherd_herd::store::{
    BlockStore, Caching, Copies, DirectoryStore, Prefixed, RetryPolicy, Retrying, S3Settings, S3Store, SceneObjects,
    Spilling, StoreError,
};
use rayherd_scene::objects::{DirectoryObjects, ObjectStore};
use tokio::runtime::Runtime;

use crate::fault::Mistake;
use crate::interrupt;
use crate::kept::prefix;

/// Where all jobs are.
pub const JOBS: &str = "jobs/";

/// How S3 is reached.
#[derive(Args, Default)]
pub struct S3Options {
    /// Address of an S3 server that is not AWS, such as http://localhost:9000 [default: AWS_ENDPOINT_URL, or AWS];
    /// keys come from AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY
    #[arg(long, value_name = "URL")]
    pub s3_endpoint: Option<String>,
    /// Keep what is read of a prepared scene in S3 in a temporary folder too, up to so many bytes: what memory drops is fetched once
    #[arg(long, value_name = "SIZE")]
    s3_cache: Option<ByteSize>,
}

impl S3Options {
    /// The server at this address.
    pub fn at(url: &str) -> Self {
        S3Options { s3_endpoint: Some(url.to_owned()), ..S3Options::default() }
    }
}

/// An open store.
pub struct Store {
    /// Its objects by key.
    pub blocks: Arc<dyn BlockStore>,
    /// Prepared scenes in it.
    pub objects: Arc<dyn ObjectStore>,
    /// Bytes of files that were put so far; of a folder none are counted.
    pub sent: Arc<AtomicU64>,
    runtime: Runtime,
}

impl Store {
    /// Opens a store, and makes the folder if it is not there.
    pub fn open(address: &str, s3: &S3Options) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.context("cannot start a thread for input and output")?;
        if address.starts_with("s3://") {
            let settings = S3Settings::from_url(address, s3.s3_endpoint.as_deref())?;
            let server = settings.endpoint.clone().unwrap_or_else(|| format!("AWS in {}", settings.region));
            let bucket = runtime.block_on(S3Store::connect(settings)).map_err(|error| {
                let remedy = match error {
                    StoreError::Unavailable { .. } => "see that the server runs and that --s3-endpoint is its address",
                    StoreError::Denied { .. } => "see that AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY are its keys",
                    _ => "see that the address and the bucket are right",
                };
                anyhow::Error::new(error).context(format!("cannot open {address} at {server} ({remedy})"))
            })?;
            let sent = bucket.sent();
            let blocks: Arc<dyn BlockStore> = Arc::new(Retrying::new(Arc::new(bucket), RetryPolicy::default()));
            let read: Arc<dyn BlockStore> = match s3.s3_cache {
                None => blocks.clone(),
                Some(size) => {
                    let near = Spilling::new(0, interrupt::remove_at_end);
                    let copies = Arc::new(Copies::new(Arc::new(near), size.bytes()));
                    // what is named by its hash never changes
                    let keeps = |key: &str| key.starts_with("objects/");
                    Arc::new(Caching::new(blocks.clone(), copies, keeps))
                }
            };
            let objects = Arc::new(SceneObjects::new(read, runtime.handle().clone())?);
            return Ok(Store { blocks, objects, sent, runtime });
        }
        for (flag, given) in [("--s3-endpoint", s3.s3_endpoint.is_some()), ("--s3-cache", s3.s3_cache.is_some())] {
            if given {
                return Err(Mistake(format!("{flag} is for a store s3://bucket/prefix, not for {address}")).into());
            }
        }
        if address.is_empty() || address.contains("://") {
            return Err(Mistake(format!("{address:?} is no store: name a folder, or s3://bucket/prefix")).into());
        }
        let cannot = || format!("cannot open the store {address}: name a folder that can be written to");
        let blocks = Arc::new(DirectoryStore::open(address).with_context(cannot)?);
        let objects = Arc::new(DirectoryObjects::open(address).with_context(cannot)?);
        Ok(Store { blocks, objects, sent: Arc::default(), runtime })
    }

    /// Opens a store that must be there already.
    pub fn existing(address: &str, s3: &S3Options) -> anyhow::Result<Self> {
        if !address.starts_with("s3://") && !Path::new(address).is_dir() {
            return Err(Mistake(format!("there is no store {address}: name a folder that holds one")).into());
        }
        Store::open(address, s3)
    }

    /// The part of the store that belongs to one picture ([`crate::kept::prefix`]), however its scene is cut.
    pub fn job(&self, image: &str) -> anyhow::Result<Arc<dyn BlockStore>> {
        self.part(&prefix(image))
    }

    /// What is below a prefix without slash at its end.
    pub fn part(&self, prefix: &str) -> anyhow::Result<Arc<dyn BlockStore>> {
        Ok(Arc::new(Prefixed::new(self.blocks.clone(), prefix)?))
    }

    /// Waits for an operation.
    pub fn wait<T>(&self, operation: impl Future<Output = T>) -> T {
        self.runtime.block_on(operation)
    }
}

/// Where a run without a store keeps its prepared scene: in memory while it is small, then in a temporary folder.
pub struct Temporary {
    /// Prepared scenes in it.
    pub objects: Arc<dyn ObjectStore>,
    spilling: Arc<Spilling>,
    // its thread does what `objects` asks for
    _runtime: Runtime,
}

impl Temporary {
    /// Up to so many bytes stay in memory.
    pub fn new(in_memory: u64) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.context("cannot start a thread for input and output")?;
        let spilling = Arc::new(Spilling::new(in_memory, interrupt::remove_at_end));
        let objects = Arc::new(SceneObjects::new(spilling.clone(), runtime.handle().clone())?);
        Ok(Temporary { objects, spilling, _runtime: runtime })
    }

    /// Bytes that went to the folder.
    pub fn spilled(&self) -> u64 {
        self.spilling.spilled()
    }
}
