"""Where the recordings come from, and how a copy is fetched and checked."""

import hashlib
import http.client
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import write_whole

_WAIT_S = 60.0
_MOST_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Source:
    """A public repository with recordings, at one commit.

    Attributes:
        name: What we call the recordings, and their folder.
        what: What was recorded, by whom.
        repository: Owner and name on GitHub.
        commit: The commit, 40 hexadecimal digits.
        licence: What the repository says about use.
        files: SHA-256 of each file by its path in the repository.
    """

    name: str
    what: str
    repository: str
    commit: str
    licence: str
    files: dict[str, str]

    def address(self, path: str) -> str:
        """Address of a file at the commit."""
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/{path}"

    def file(self, folder: Path, path: str) -> Path:
        """A copy of one file in a folder of recordings.

        Raises:
            ConfigurationError: It is not there, or is another file.
        """
        copy = folder / self.name / Path(path).name
        if not copy.is_file():
            raise ConfigurationError(
                f"{copy} is not there; get it by --fetch, or by hand from {self.address(path)}"
            )
        digest = hashlib.sha256(copy.read_bytes()).hexdigest()
        if digest != self.files[path]:
            raise ConfigurationError(
                f"{copy} is not the file that was measured: SHA-256 {digest}, expected"
                f" {self.files[path]}; delete it and fetch it anew"
            )
        return copy

    def fetch(self, folder: Path, show: Callable[[str], None]) -> None:
        """Fetch the files that a folder does not have yet.

        Args:
            folder: Folder of recordings.
            show: Called with the address of each file.

        Raises:
            ConfigurationError: A file cannot be reached, or is another one than expected.
        """
        for path in self.files:
            copy = folder / self.name / Path(path).name
            if copy.is_file():
                continue
            address = self.address(path)
            show(address)
            try:
                with urllib.request.urlopen(address, timeout=_WAIT_S) as answer:
                    content = answer.read(_MOST_BYTES)
            except (OSError, http.client.HTTPException) as error:
                raise ConfigurationError(f"cannot fetch {address}: {error}") from None
            digest = hashlib.sha256(content).hexdigest()
            if digest != self.files[path]:
                raise ConfigurationError(
                    f"what {address} sent is not the file that was measured: SHA-256 {digest},"
                    f" expected {self.files[path]}; nothing was written, try again later"
                )
            copy.parent.mkdir(parents=True, exist_ok=True)
            write_whole(copy, content)


JUSTIN = Source(
    name="agile_justin",
    what="500 static poses of the humanoid Agile Justin, its hands tracked by cameras, by DLR and"
    " AIDX Lab",
    repository="dlr-alr/dlr-elastic-calibration",
    commit="35149b71639187d0e05f798f679049ff59442756",
    licence="none is stated",
    files={
        "dataset/measurements.csv.zip": (
            "e56d4d2bceae6283105d643d7e4fa847731323bc84f7fb5eb8bf978d9125dfab"
        )
    },
)

XL330 = Source(
    name="xl330",
    what="16 logs of a Dynamixel XL330-M288 with a pendulum, by Rhoban",
    repository="Rhoban/bam",
    commit="af2260462471ff45ac18af159b1327ea51d8db15",
    licence="Apache-2.0",
    files={
        "bam/data.bak/raw/2026-01-15_10h28m10.json": (
            "e58f3c2a08a5e0e37a2c5e930d0830a438bc102b8d21482767124f495b92f2ce"
        ),
        "bam/data.bak/raw/2026-01-15_10h28m17.json": (
            "ef6507934ba465eb31529d7d98715ecc70bd5c87be049fd4618a94ce39290569"
        ),
        "bam/data.bak/raw/2026-01-15_10h28m24.json": (
            "165b171df12b3e8b39504ce36d37e373ad105c0dddf4d3d073c747fd492e8bef"
        ),
        "bam/data.bak/raw/2026-01-15_10h28m32.json": (
            "fdc255edae6995298af437f37582eb8cd0c4a5ddcec4f49fb7c4d6f3303aaa9c"
        ),
        "bam/data.bak/raw/2026-01-15_10h28m42.json": (
            "1c6386bfa3be021c8ca8a96a7cbee93914f6271a050282b1c3b7d5ef373427db"
        ),
        "bam/data.bak/raw/2026-01-15_10h28m49.json": (
            "e2223826274fca7799a2be0cb371e4269ead88cd9077fbb68498ef93e4e0de97"
        ),
        "bam/data.bak/raw/2026-01-15_10h28m57.json": (
            "c10a350d9c7222d4d3499d140edd3ac4e63fe94f3b59a675116a34db7d66152c"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m04.json": (
            "7996c43314a9f60094a6119346b54ff9ff84cb6726c967f4a88a7175278f6515"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m14.json": (
            "016d15d21c464457aa30eaeab3977228b08cd5acf7542f24067440126c0bf480"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m21.json": (
            "fe68cff62e976c87a2fcab925a517fbff83be16c862693310fdc1eff743eddab"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m29.json": (
            "b9ce9fc0f396e6b03bd514e9254cb83b8a64e1a5df1728b9a10e3b4a5a9513ca"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m37.json": (
            "838d390b7190c4ce1608157cf629989648773b7336728a0931a61c6018c6700b"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m47.json": (
            "61ae8eeb881be5d8c09f6c7fba4cef39f66b1ff03e0148ef3bc0e314054513f5"
        ),
        "bam/data.bak/raw/2026-01-15_10h29m54.json": (
            "b50055742ee553a8cb849b38d04d2b9bcf7143d0acefe6539f922984b93d958a"
        ),
        "bam/data.bak/raw/2026-01-15_10h30m02.json": (
            "040e065f9885833fa909683f13665f90048ce5457d94dd2a3af056c21c36210d"
        ),
        "bam/data.bak/raw/2026-01-15_10h30m10.json": (
            "01d32db99e7859f012a230aca59f1dda24219d6781472d356861b138526213e6"
        ),
    },
)

STS3250 = Source(
    name="sts3250",
    what="4 logs of a Feetech STS3250 with a pendulum, by Rhoban",
    repository="Rhoban/bam",
    commit="b53408c590cb4d65f90abd25fe062ddd00505a93",
    licence="Apache-2.0, added after this commit",
    files={
        "data_raw_feetech/2024-10-26_12h23m27.json": (
            "78d697ce9104c26d6452e41805de4649b75ec6de2c790bd2dfed403a461d7992"
        ),
        "data_raw_feetech/2024-10-26_12h23m42.json": (
            "1f2f6f02902d579d8b9a96fc6bd710f613cd7ce436a953a2d2ebd851ce1ef908"
        ),
        "data_raw_feetech/2024-10-26_12h24m55.json": (
            "a4bfe27a8bf8756cfe5a0eb5d874a17efa54bdce407312269229555a2a29bc95"
        ),
        "data_raw_feetech/2024-10-26_12h27m27.json": (
            "d84c743319df38b9221010d7cef2572f08ca07b73730cbded634a99ed815dace"
        ),
    },
)

SOURCES = (JUSTIN, XL330, STS3250)
