//! The operator's own certificate authority. Workers trust it and nobody else.
//!
//! It lives in a Secret beside the operator, so that the next operator has the same. A root signs for a year and a half; half a year
//! before, the next root is made, and workers that start from then on trust both, so that those who run at the change go on.

use std::time::Duration;

use k8s_openapi::ByteString;
use k8s_openapi::api::core::v1::Secret;
use kube::api::{ObjectMeta, PostParams};
use kube::{Api, Client};
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};
use rustls::crypto::ring::sign::any_supported_type;
use rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::sign::CertifiedKey;
use time::OffsetDateTime;

/// A root is valid for so long, seconds.
const ROOT: i64 = 2 * 365 * DAY;
/// With less than this left the next root is made.
const NEXT: i64 = 365 * DAY;
/// With less than this left the next root signs.
const CHANGE: i64 = 180 * DAY;
/// The task server's certificate is valid for so long.
const SERVING: i64 = 30 * DAY;
const DAY: i64 = 24 * 3600;
/// Clocks of workers may be behind ours by so much.
const SKEW: i64 = 3600;
/// Tries, when several operators begin at the same time.
const TRIES: u32 = 10;

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
pub enum AuthorityError {
    /// The API server did not do it.
    #[error("cannot keep the certificate authority in Secret {name}: {source}")]
    Api {
        /// Which Secret.
        name: String,
        /// Why not.
        source: kube::Error,
    },
    /// What is in the Secret is not what was put there.
    #[error("Secret {0} is no certificate authority: delete it, and start the operator and the jobs' workers again")]
    Broken(String),
    /// A certificate cannot be made.
    #[error("cannot make a certificate: {0}")]
    Make(#[from] rcgen::Error),
    /// A key cannot be used.
    #[error("cannot use a certificate's key: {0}")]
    Key(#[from] rustls::Error),
}

/// A key that signs, and its certificate.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Root {
    certificate: String,
    key: String,
    /// When it ends, seconds since 1970.
    until: i64,
}

/// The root that signs, and the one that will.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Roots {
    signs: Root,
    next: Option<Root>,
}

/// A certificate to serve with, and when to have another.
pub struct Serving {
    /// With its key.
    pub key: CertifiedKey,
    /// Half of its life, seconds since 1970.
    pub renew: i64,
}

impl Root {
    fn make(now: i64) -> Result<Self, AuthorityError> {
        let key = KeyPair::generate()?;
        let until = now + ROOT;
        let certificate = root_params(now, until)?.self_signed(&key)?;
        Ok(Root { certificate: certificate.pem(), key: key.serialize_pem(), until })
    }
}

fn root_params(from: i64, until: i64) -> Result<CertificateParams, AuthorityError> {
    let mut params = CertificateParams::new(Vec::new())?;
    params.distinguished_name.push(DnType::CommonName, "rayherd workers' authority");
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::DigitalSignature];
    (params.not_before, params.not_after) = (at(from - SKEW), at(until));
    Ok(params)
}

fn at(seconds: i64) -> OffsetDateTime {
    // in the range that a certificate can say, or the end of it
    OffsetDateTime::from_unix_timestamp(seconds).unwrap_or(OffsetDateTime::UNIX_EPOCH)
}

impl Roots {
    /// What should be kept at this time: the same, or with a new root.
    ///
    /// # Errors
    /// When no key can be made.
    pub fn renewed(kept: Option<Roots>, now: i64) -> Result<Self, AuthorityError> {
        let Some(Roots { mut signs, mut next }) = kept.filter(|r| r.signs.until > now) else {
            return Ok(Roots { signs: Root::make(now)?, next: None });
        };
        if signs.until - now < NEXT && next.is_none() {
            next = Some(Root::make(now)?);
        }
        if signs.until - now < CHANGE
            && let Some(root) = next.take()
        {
            signs = root;
        }
        Ok(Roots { signs, next })
    }

    /// The certificates that workers trust, as PEM.
    pub fn bundle(&self) -> String {
        let next = self.next.as_ref().map_or("", |n| &n.certificate);
        format!("{}{next}", self.signs.certificate)
    }

    /// A certificate for a server of this name.
    ///
    /// # Errors
    /// When the root cannot sign, or the name is none.
    pub fn serving(&self, host: &str, now: i64) -> Result<Serving, AuthorityError> {
        let root = &self.signs;
        let issuer = Issuer::new(root_params(now, root.until)?, KeyPair::from_pem(&root.key)?);
        let mut params = CertificateParams::new(vec![host.to_owned()])?;
        params.distinguished_name.push(DnType::CommonName, host);
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        (params.not_before, params.not_after) = (at(now - SKEW), at(root.until.min(now + SERVING)));
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &issuer)?;
        let private = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key.serialize_der()));
        let key = CertifiedKey::new(vec![certificate.der().clone()], any_supported_type(&private)?);
        Ok(Serving { key, renew: now + SERVING / 2 })
    }

    fn from_secret(secret: &Secret) -> Option<Self> {
        let text = |name: &str| {
            let ByteString(bytes) = secret.data.as_ref()?.get(name)?;
            String::from_utf8(bytes.clone()).ok()
        };
        let root = |name: &str| {
            Some(Root {
                certificate: text(&format!("{name}.crt"))?,
                key: text(&format!("{name}.key"))?,
                until: text(&format!("{name}.until"))?.parse().ok()?,
            })
        };
        Some(Roots { signs: root("signs")?, next: root("next") })
    }

    fn to_secret(&self, metadata: ObjectMeta) -> Secret {
        let roots = [("signs", Some(&self.signs)), ("next", self.next.as_ref())];
        let all = roots.into_iter().filter_map(|(name, root)| Some((name, root?)));
        let data = all.flat_map(|(name, root)| {
            let entry = |end: &str, text: &str| (format!("{name}.{end}"), ByteString(text.as_bytes().to_vec()));
            [entry("crt", &root.certificate), entry("key", &root.key), entry("until", &root.until.to_string())]
        });
        Secret { metadata, data: Some(data.collect()), ..Secret::default() }
    }
}

/// The roots of the Secret; made or renewed if it is time. Several operators may do so at once: one of them wins.
pub async fn load(client: &Client, namespace: &str, name: &str, now: i64) -> Result<Roots, AuthorityError> {
    let secrets: Api<Secret> = Api::namespaced(client.clone(), namespace);
    let api = |source| AuthorityError::Api { name: format!("{namespace}/{name}"), source };
    let mut tries = 0;
    loop {
        let found = secrets.get_opt(name).await.map_err(api)?;
        let kept = match &found {
            // an empty one is what an administrator leaves who wants another authority
            Some(secret) if secret.data.as_ref().is_some_and(|d| !d.is_empty()) => {
                let broken = || AuthorityError::Broken(format!("{namespace}/{name}"));
                Some(Roots::from_secret(secret).ok_or_else(broken)?)
            }
            _ => None,
        };
        let roots = Roots::renewed(kept.clone(), now)?;
        if kept.as_ref() == Some(&roots) {
            return Ok(roots);
        }
        let post = PostParams::default();
        let written = match found {
            None => {
                let metadata = ObjectMeta { name: Some(name.into()), ..ObjectMeta::default() };
                secrets.create(&post, &roots.to_secret(metadata)).await
            }
            Some(old) => secrets.replace(name, &post, &roots.to_secret(old.metadata)).await,
        };
        tries += 1;
        match written {
            Ok(_) => return Ok(roots),
            Err(kube::Error::Api(e)) if e.code == 409 && tries < TRIES => {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
            Err(e) => return Err(api(e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::tests::{Step, conflict, context, not_found, serve, step};

    const SECRET: &str = "/api/v1/namespaces/rayherd/secrets/authority";

    async fn loaded(now: i64, steps: Vec<Step>) -> (Roots, Vec<Value>) {
        let (context, server) = context();
        let serving = tokio::spawn(serve(server, steps));
        let roots = load(&context.client, "rayherd", "authority", now).await.unwrap();
        (roots, serving.await.unwrap())
    }

    #[tokio::test]
    async fn of_operators_that_make_it_at_once_all_have_the_same() {
        let begin = 1_800_000_000;
        let secret = |roots: &Roots| {
            let metadata = ObjectMeta {
                name: Some("authority".into()),
                resource_version: Some("7".into()),
                ..ObjectMeta::default()
            };
            serde_json::to_value(roots.to_secret(metadata)).unwrap()
        };
        let theirs = Roots::renewed(None, begin).unwrap();
        let other_was_faster = vec![
            step("GET", SECRET, 404, not_found()),
            step("POST", "/api/v1/namespaces/rayherd/secrets?", 409, conflict()),
            step("GET", SECRET, 200, secret(&theirs)),
        ];
        let (roots, _) = loaded(begin, other_was_faster).await;
        assert_eq!(roots, theirs);
        // nothing is written where nothing is to be changed
        let (roots, _) = loaded(begin, vec![step("GET", SECRET, 200, secret(&theirs))]).await;
        assert_eq!(roots, theirs);
        // renewed over the version that was read, and what the other made is taken where that was another
        let late = begin + ROOT - NEXT + DAY;
        let renewed = Roots::renewed(Some(theirs.clone()), late).unwrap();
        let steps = vec![
            step("GET", SECRET, 200, secret(&theirs)),
            step("PUT", SECRET, 409, conflict()),
            step("GET", SECRET, 200, secret(&renewed)),
        ];
        let (roots, said) = loaded(late, steps).await;
        assert_eq!(roots, renewed);
        assert_eq!(said[1].pointer("/metadata/resourceVersion"), Some(&json!("7")));
        // an administrator has emptied it
        let mut empty = secret(&theirs);
        empty["data"] = json!({});
        let steps = vec![step("GET", SECRET, 200, empty), step("PUT", SECRET, 200, secret(&theirs))];
        let (roots, said) = loaded(begin, steps).await;
        assert_ne!(roots, theirs);
        let written: Secret = serde_json::from_value(said[1].clone()).unwrap();
        assert_eq!(Roots::from_secret(&written), Some(roots));
    }

    #[test]
    fn roots_overlap_and_survive_their_secret() {
        let begin = 1_800_000_000;
        let first = Roots::renewed(None, begin).unwrap();
        assert_eq!(Roots::renewed(Some(first.clone()), begin + DAY).unwrap(), first);
        let both = Roots::renewed(Some(first.clone()), begin + ROOT - NEXT + DAY).unwrap();
        assert_eq!(both.signs, first.signs, "who started before trusts the old one alone");
        assert!(both.bundle().starts_with(&first.bundle()) && both.bundle().matches("BEGIN").count() == 2);
        assert_eq!(Roots::renewed(Some(both.clone()), begin + ROOT - CHANGE - DAY).unwrap(), both);
        let second = Roots::renewed(Some(both.clone()), begin + ROOT - CHANGE + DAY).unwrap();
        assert_eq!((Some(&second.signs), &second.next), (both.next.as_ref(), &None));
        for roots in [&first, &both, &second] {
            assert_eq!(Roots::from_secret(&roots.to_secret(ObjectMeta::default())).as_ref(), Some(roots));
        }
        // slept through all of it
        let late = Roots::renewed(Some(first.clone()), begin + ROOT + DAY).unwrap();
        assert_ne!(late.signs, first.signs);
        let mut damaged = first.to_secret(ObjectMeta::default());
        damaged.data.as_mut().unwrap().remove("signs.key");
        assert_eq!(Roots::from_secret(&damaged), None);
    }
}
