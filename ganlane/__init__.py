"""ganlane: reinforcement learning for highway driving in traffic that behaves like people.

The package reads from the bottom up, and imports run only downwards:

``data``, ``sim``  <-  ``generator``  <-  ``traffic``  <-  ``env``  <-  ``transforms``  <-  ``agents``  <-
``evaluation``  <-  ``training``  <-  ``view``  <-  ``config``, ``api``, ``gym``  <-  entry points.

Three small modules stand under all of them: ``keys`` (every TensorDict key, declared once), ``errors``
(a user's mistake, told in one sentence) and ``files`` (atomic writes and safe checkpoints).
"""

__version__ = "0.1.0"
