"""Train one experiment: python train.py --config conf/double_integrator.yaml [key.sub=value ...]."""

import sys

from lyapnet.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
