//! An S3 server in this process, for tests: buckets in memory behind real HTTP on loopback, with faults on request.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Method, Request};
use hyper_util::rt::TokioIo;
use s3s::auth::SimpleAuth;
use s3s::dto::{
    DeleteObjectsInput, DeleteObjectsOutput, GetObjectInput, GetObjectOutput, HeadObjectInput, HeadObjectOutput,
    ListObjectsV2Input, ListObjectsV2Output, Object, PutObjectInput, PutObjectOutput, StreamingBlob,
};
use s3s::service::{S3Service, S3ServiceBuilder};
use s3s::{Body, HttpError, HttpResponse, S3, S3Request, S3Response, S3Result, s3_error};

use super::{S3Credentials, S3Settings};

/// The name of the bucket that every server has.
pub const BUCKET: &str = "test-bucket";

/// What goes wrong, and how often: shares of 1000 requests, drawn from the seed and the number of the request.
#[derive(Clone, Copy, Debug, Default)]
pub struct S3Faults {
    /// Draws them.
    pub seed: u64,
    /// Answered with 503 SlowDown and not done.
    pub unavailable: u32,
    /// Answered with 403 and nothing else and not done, as MinIO of 2021 does while it starts.
    pub starting: u32,
    /// Done, but the connection ends before the answer.
    pub lost_reply: u32,
    /// GET: the connection ends in the middle of the body.
    pub cut_body: u32,
    /// Every request waits so long.
    pub latency: Duration,
}

/// A running server; ends with this value.
pub struct S3Server {
    endpoint: String,
    state: Arc<State>,
    task: tokio::task::JoinHandle<()>,
}

#[derive(Default)]
struct State {
    objects: Mutex<BTreeMap<String, Bytes>>,
    faults: Mutex<S3Faults>,
    requests: AtomicU64,
    injected: AtomicU64,
    /// By key: how often its object was read.
    reads: Mutex<BTreeMap<String, u64>>,
}

impl S3Server {
    /// Starts on a free port of 127.0.0.1.
    ///
    /// # Panics
    /// When the port cannot be had.
    pub async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port on loopback");
        let endpoint = format!("http://{}", listener.local_addr().expect("its address"));
        let state = Arc::new(State::default());
        let mut builder = S3ServiceBuilder::new(Buckets(state.clone()));
        builder.set_auth(SimpleAuth::from_single("test-key", "test-secret"));
        let task = tokio::spawn(serve(listener, builder.build(), state.clone()));
        S3Server { endpoint, state, task }
    }

    /// How to reach it, with everything below `prefix`.
    pub fn settings(&self, prefix: &str) -> S3Settings {
        S3Settings {
            bucket: BUCKET.to_owned(),
            prefix: prefix.to_owned(),
            endpoint: Some(self.endpoint.clone()),
            region: "us-east-1".to_owned(),
            path_style: true,
            credentials: S3Credentials {
                access_key: "test-key".to_owned(),
                secret_key: "test-secret".to_owned(),
                session_token: None,
            },
        }
    }

    /// From now on, these.
    pub fn set_faults(&self, faults: S3Faults) {
        *lock(&self.state.faults) = faults;
    }

    /// Requests that came, and how many of them went wrong on purpose.
    pub fn requests(&self) -> (u64, u64) {
        (self.state.requests.load(Ordering::Relaxed), self.state.injected.load(Ordering::Relaxed))
    }

    /// How often each object whose key begins so was read.
    pub fn reads(&self, prefix: &str) -> BTreeMap<String, u64> {
        let reads = lock(&self.state.reads);
        reads.iter().filter(|r| r.0.starts_with(prefix)).map(|(key, &n)| (key.clone(), n)).collect()
    }

    /// Puts an object past every rule, as another program would.
    pub fn put_raw(&self, path: &str, body: &'static [u8]) {
        lock(&self.state.objects).insert(path.to_owned(), Bytes::from_static(body));
    }
}

impl Drop for S3Server {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Fate {
    Served,
    Unavailable,
    Starting,
    LostReply,
    CutBody,
}

impl State {
    fn fate(&self, reads: bool) -> (Fate, Duration) {
        let faults = *lock(&self.faults);
        let number = self.requests.fetch_add(1, Ordering::Relaxed);
        let hash = blake3::hash(&[faults.seed.to_le_bytes(), number.to_le_bytes()].concat());
        let mut draw = u32::from_le_bytes(std::array::from_fn(|i| hash.as_bytes()[i])) % 1000;
        let cut_body = if reads { faults.cut_body } else { 0 };
        let shares = [
            (Fate::Unavailable, faults.unavailable),
            (Fate::Starting, faults.starting),
            (Fate::LostReply, faults.lost_reply),
            (Fate::CutBody, cut_body),
        ];
        for (fate, share) in shares {
            if draw < share {
                self.injected.fetch_add(1, Ordering::Relaxed);
                return (fate, faults.latency);
            }
            draw -= share;
        }
        (Fate::Served, faults.latency)
    }
}

async fn serve(listener: tokio::net::TcpListener, service: S3Service, state: Arc<State>) {
    // dropped, and the connections with it, when the server is
    let mut connections = tokio::task::JoinSet::new();
    while let Ok((socket, _)) = listener.accept().await {
        let (service, state) = (service.clone(), state.clone());
        connections.spawn(async move {
            let answer = service_fn(move |request| answer(service.clone(), state.clone(), request));
            // ends with an error when a fault cuts it or the client leaves: both are the client's to notice
            let _ = hyper::server::conn::http1::Builder::new().serve_connection(TokioIo::new(socket), answer).await;
        });
    }
}

async fn answer(service: S3Service, state: Arc<State>, request: Request<Incoming>) -> Result<HttpResponse, HttpError> {
    let (fate, latency) = state.fate(request.method() == Method::GET);
    if !latency.is_zero() {
        tokio::time::sleep(latency).await;
    }
    if fate == Fate::Unavailable {
        let body = "<Error><Code>SlowDown</Code><Message>on purpose</Message></Error>".to_owned();
        let response = hyper::Response::builder().status(503).body(Body::from(body));
        return response.map_err(|e| HttpError::new(Box::new(e)));
    }
    if fate == Fate::Starting {
        let response = hyper::Response::builder().status(403).body(Body::empty());
        return response.map_err(|e| HttpError::new(Box::new(e)));
    }
    let response = service.call(request.map(Body::from)).await?;
    match fate {
        Fate::LostReply => Err(HttpError::new("lost on purpose".into())),
        Fate::CutBody => {
            let (parts, body) = response.into_parts();
            let whole: Vec<Bytes> = body.into_stream().try_collect().await.map_err(HttpError::new)?;
            let whole = whole.concat();
            let half = Bytes::copy_from_slice(&whole[..whole.len() / 2]);
            let cut = stream::iter([Ok(half), Err(std::io::Error::other("cut on purpose"))]);
            Ok(HttpResponse::from_parts(parts, Body::from(StreamingBlob::wrap(cut))))
        }
        _ => Ok(response),
    }
}

struct Buckets(Arc<State>);

impl Buckets {
    fn objects(&self, bucket: &str) -> S3Result<MutexGuard<'_, BTreeMap<String, Bytes>>> {
        if bucket == BUCKET { Ok(lock(&self.0.objects)) } else { Err(s3_error!(NoSuchBucket)) }
    }
}

#[async_trait]
impl S3 for Buckets {
    async fn put_object(&self, request: S3Request<PutObjectInput>) -> S3Result<S3Response<PutObjectOutput>> {
        let input = request.input;
        drop(self.objects(&input.bucket)?);
        let mut body = Vec::new();
        if let Some(mut parts) = input.body {
            while let Some(part) = parts.next().await {
                body.extend_from_slice(&part.map_err(|_| s3_error!(IncompleteBody))?);
            }
        }
        if input.content_length.is_some_and(|n| n != body.len() as i64) {
            return Err(s3_error!(IncompleteBody));
        }
        self.objects(&input.bucket)?.insert(input.key, body.into());
        Ok(S3Response::new(PutObjectOutput::default()))
    }

    async fn get_object(&self, request: S3Request<GetObjectInput>) -> S3Result<S3Response<GetObjectOutput>> {
        let body = self.objects(&request.input.bucket)?.get(&request.input.key).cloned();
        let body = body.ok_or_else(|| s3_error!(NoSuchKey))?;
        *lock(&self.0.reads).entry(request.input.key.clone()).or_default() += 1;
        let length = body.len() as i64;
        // in parts, as a network would
        let parts: Vec<Bytes> =
            (0..body.len()).step_by(1 << 20).map(|i| body.slice(i..body.len().min(i + (1 << 20)))).collect();
        let body = StreamingBlob::wrap(stream::iter(parts.into_iter().map(Ok::<_, std::io::Error>)));
        let output = GetObjectOutput { body: Some(body), content_length: Some(length), ..Default::default() };
        Ok(S3Response::new(output))
    }

    async fn head_object(&self, request: S3Request<HeadObjectInput>) -> S3Result<S3Response<HeadObjectOutput>> {
        let objects = self.objects(&request.input.bucket)?;
        let body = objects.get(&request.input.key).ok_or_else(|| s3_error!(NoSuchKey))?;
        let output = HeadObjectOutput { content_length: Some(body.len() as i64), ..Default::default() };
        Ok(S3Response::new(output))
    }

    async fn list_objects_v2(
        &self,
        request: S3Request<ListObjectsV2Input>,
    ) -> S3Result<S3Response<ListObjectsV2Output>> {
        let input = request.input;
        let prefix = input.prefix.clone().unwrap_or_default();
        let after = input.continuation_token.or(input.start_after).unwrap_or_default();
        let most = usize::try_from(input.max_keys.unwrap_or(1000)).unwrap_or(0).min(1000);
        let objects = self.objects(&input.bucket)?;
        let mut found: Vec<Object> = objects
            .iter()
            .filter(|(key, _)| key.starts_with(&prefix) && **key > after)
            .take(most + 1)
            .map(|(key, body)| Object { key: Some(key.clone()), size: Some(body.len() as i64), ..Default::default() })
            .collect();
        let truncated = found.len() > most;
        found.truncate(most);
        let output = ListObjectsV2Output {
            next_continuation_token: found.last().filter(|_| truncated).and_then(|o| o.key.clone()),
            is_truncated: Some(truncated),
            key_count: Some(found.len() as i32),
            contents: Some(found),
            name: Some(input.bucket),
            prefix: input.prefix,
            ..Default::default()
        };
        Ok(S3Response::new(output))
    }

    async fn delete_objects(
        &self,
        request: S3Request<DeleteObjectsInput>,
    ) -> S3Result<S3Response<DeleteObjectsOutput>> {
        // as MinIO of 2021 does
        if !request.headers.contains_key("content-md5") {
            return Err(s3_error!(InvalidRequest, "Missing required header for this request: Content-Md5."));
        }
        if request.input.delete.objects.len() > 1000 {
            return Err(s3_error!(MalformedXML));
        }
        let mut objects = self.objects(&request.input.bucket)?;
        for object in request.input.delete.objects {
            objects.remove(&object.key);
        }
        Ok(S3Response::new(DeleteObjectsOutput::default()))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
