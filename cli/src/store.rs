//! Stores by address: a folder, or `s3://bucket/prefix`.
//!
//! A store holds prepared scenes (`objects/`, `names/`) and, per image, the commits of its job (`jobs/IMAGE/`).

use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use clap::Args;
use rayherd_herd::store::{
    BlockStore, DirectoryStore, Prefixed, RetryPolicy, Retrying, S3Settings, S3Store, SceneObjects, StoreError,
};
use rayherd_render::frame::Frame;
use rayherd_scene::objects::{DirectoryObjects, ObjectHash, ObjectStore};
use rayherd_scene::prepare::Prepared;
use tokio::runtime::Runtime;

use crate::fault::Mistake;

/// Where all jobs are.
pub const JOBS: &str = "jobs/";

/// How S3 is reached.
#[derive(Args, Default)]
pub struct S3Options {
    /// Address of an S3 server that is not AWS, such as http://localhost:9000 [default: AWS_ENDPOINT_URL, or AWS];
    /// keys come from AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY
    #[arg(long, value_name = "URL")]
    s3_endpoint: Option<String>,
}

/// An open store.
pub struct Store {
    /// Its objects by key.
    pub blocks: Arc<dyn BlockStore>,
    /// Prepared scenes in it.
    pub objects: Arc<dyn ObjectStore>,
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
            let blocks: Arc<dyn BlockStore> = Arc::new(Retrying::new(Arc::new(bucket), RetryPolicy::default()));
            let objects = Arc::new(SceneObjects::new(blocks.clone(), runtime.handle().clone())?);
            return Ok(Store { blocks, objects, runtime });
        }
        if s3.s3_endpoint.is_some() {
            return Err(Mistake(format!("--s3-endpoint is for a store s3://bucket/prefix, not for {address}")).into());
        }
        let blocks = Arc::new(DirectoryStore::open(address)?);
        let objects = Arc::new(DirectoryObjects::open(address)?);
        Ok(Store { blocks, objects, runtime })
    }

    /// Opens a store that must be there already.
    pub fn existing(address: &str, s3: &S3Options) -> anyhow::Result<Self> {
        if !address.starts_with("s3://") && !Path::new(address).is_dir() {
            return Err(Mistake(format!("there is no store {address}: name a folder that holds one")).into());
        }
        Store::open(address, s3)
    }

    /// The part of the store that belongs to one image of a prepared scene.
    ///
    /// Ray groups that wait name splits, so another cut of the same scene has a place of its own.
    pub fn job(&self, prepared: &Prepared, frame: &Frame) -> anyhow::Result<Arc<dyn BlockStore>> {
        let image = serde_json::to_vec(&(prepared.reference.hash, frame)).context("cannot write the frame down")?;
        let name = ObjectHash::of(&image).to_string();
        self.part(&format!("{JOBS}{}", &name[..16]))
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
