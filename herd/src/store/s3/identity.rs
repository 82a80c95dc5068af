//! As whom requests are made: with a key, or as whom a cloud says that this process is.

use aws_config::ecs::EcsCredentialsProvider;
use aws_config::provider_config::ProviderConfig;
use aws_config::web_identity_token::WebIdentityTokenCredentialsProvider;
use aws_sdk_s3::config::{Credentials, Region, SharedCredentialsProvider, SharedHttpClient};

use crate::store::StoreError;

/// As whom requests are made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum S3Credentials {
    /// Whoever has this key.
    Key(S3Key),
    /// Whom a cloud says that this process is.
    Identity(Identity),
}

/// Where a cloud hands out keys that last for an hour or so; the SDK asks again before they end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Identity {
    /// The token in `AWS_WEB_IDENTITY_TOKEN_FILE` is exchanged at STS (`AWS_ENDPOINT_URL_STS`, else AWS's own of the region) for keys of
    /// the role `AWS_ROLE_ARN`.
    WebToken,
    /// `AWS_CONTAINER_CREDENTIALS_FULL_URI` or `_RELATIVE_URI` is asked, with the token in `AWS_CONTAINER_AUTHORIZATION_TOKEN_FILE`.
    Container,
}

/// What marks each identity in the environment.
const IDENTITIES: [(&str, Identity); 3] = [
    ("AWS_WEB_IDENTITY_TOKEN_FILE", Identity::WebToken),
    ("AWS_CONTAINER_CREDENTIALS_FULL_URI", Identity::Container),
    ("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI", Identity::Container),
];

impl S3Credentials {
    /// The identity that the environment of this process speaks of.
    ///
    /// # Errors
    /// When it speaks of none.
    pub fn identity() -> Result<Self, StoreError> {
        Self::identity_in(|name| std::env::var(name).ok().filter(|value| !value.is_empty())).ok_or_else(|| {
            let message = "no identity: neither AWS_WEB_IDENTITY_TOKEN_FILE nor AWS_CONTAINER_CREDENTIALS_FULL_URI is set; a cloud sets them in \
                           pods whose service account is annotated with a role";
            StoreError::Misconfigured { store: "s3".to_owned(), message: message.to_owned() }
        })
    }

    /// The key in the environment (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`), else the identity that it speaks of.
    ///
    /// # Errors
    /// When there is neither; the name of the variable that lacks.
    pub fn from_env() -> Result<Self, String> {
        Self::from_variables(|name| std::env::var(name).ok().filter(|value| !value.is_empty()))
    }

    pub(super) fn from_variables(variable: impl Fn(&str) -> Option<String>) -> Result<Self, String> {
        if let (None, Some(identity)) = (variable("AWS_ACCESS_KEY_ID"), Self::identity_in(&variable)) {
            return Ok(identity);
        }
        let hint = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY";
        let need = |name: &str| variable(name).ok_or_else(|| format!("no credentials: {name} is not set ({hint})"));
        Ok(S3Credentials::Key(S3Key {
            access_key: need("AWS_ACCESS_KEY_ID")?,
            secret_key: need("AWS_SECRET_ACCESS_KEY")?,
            session_token: variable("AWS_SESSION_TOKEN"),
        }))
    }

    fn identity_in(variable: impl Fn(&str) -> Option<String>) -> Option<Self> {
        let found = IDENTITIES.into_iter().find(|(name, _)| variable(name).is_some());
        found.map(|(_, identity)| S3Credentials::Identity(identity))
    }
}

impl From<S3Key> for S3Credentials {
    fn from(key: S3Key) -> Self {
        S3Credentials::Key(key)
    }
}

/// An access key. The secrets do not show in `Debug`.
#[derive(Clone, PartialEq, Eq)]
pub struct S3Key {
    /// Its public part.
    pub access_key: String,
    /// Its secret part.
    pub secret_key: String,
    /// For temporary keys.
    pub session_token: Option<String>,
}

impl std::fmt::Debug for S3Key {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("S3Key").field("access_key", &self.access_key).finish_non_exhaustive()
    }
}

/// Whoever knows the keys.
pub(super) fn provider(credentials: &S3Credentials, region: &str, http: SharedHttpClient) -> SharedCredentialsProvider {
    let config =
        ProviderConfig::without_region().with_region(Some(Region::new(region.to_owned()))).with_http_client(http);
    match credentials {
        S3Credentials::Key(S3Key { access_key, secret_key, session_token }) => SharedCredentialsProvider::new(
            Credentials::new(access_key, secret_key, session_token.clone(), None, "rayherd settings"),
        ),
        S3Credentials::Identity(Identity::WebToken) => {
            SharedCredentialsProvider::new(WebIdentityTokenCredentialsProvider::builder().configure(&config).build())
        }
        S3Credentials::Identity(Identity::Container) => {
            SharedCredentialsProvider::new(EcsCredentialsProvider::builder().configure(&config).build())
        }
    }
}
