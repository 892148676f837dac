"""`python -m ccnn_torch` is `ccnn`."""

from ccnn_torch.cli import main

if __name__ == "__main__":
    main()
