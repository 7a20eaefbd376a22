"""Higher-order minimum cost lifted multicuts (Keuper, ICCV 2017), one step per module; see `estimator`."""
