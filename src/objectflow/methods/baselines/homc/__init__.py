"""Higher-order minimum cost lifted multicuts (Keuper, ICCV 2017), one step of the method a file; see `estimator`."""
