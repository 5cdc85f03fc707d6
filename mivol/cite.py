"""References of the methods: one table from a key to the full citation.

Conventions. A key is ``author_year`` or the name of a program. Every entry was compared with the page of the publisher, the
citation file of the project or several independent bibliographies. A DOI is given only if confirmed there.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import NamedTuple

from mivol.errors import MivolError


class Citation(NamedTuple):
    """One reference: ``authors`` (year). ``title``. ``where``; ``link`` is a DOI, an arXiv page or a home page."""

    authors: str
    year: int
    title: str
    where: str
    link: str = ""

    def __str__(self) -> str:
        return f"{self.authors} ({self.year}). {self.title}. {self.where}." + (f" {self.link}" if self.link else "")


CITATIONS: dict[str, Citation] = {
    "mitsuba3": Citation(
        "W. Jakob, S. Speierer, N. Roussel, M. Nimier-David, D. Vicini, T. Zeltner, B. Nicolet, M. Crespo, V. Leroy, Z. Zhang",
        2022,
        "Mitsuba 3 renderer",
        "Software",
        "https://mitsuba-renderer.org",
    ),
    "drjit": Citation(
        "W. Jakob, S. Speierer, N. Roussel, D. Vicini",
        2022,
        "Dr.Jit: a just-in-time compiler for differentiable rendering",
        "ACM Transactions on Graphics 41(4)",
        "https://doi.org/10.1145/3528223.3530099",
    ),
    "amanatides_1987": Citation(
        "J. Amanatides, A. Woo",
        1987,
        "A fast voxel traversal algorithm for ray tracing",
        "Eurographics 1987, Technical Papers",
        "https://doi.org/10.2312/egtp.19871000",
    ),
    "chao_1982": Citation(
        "M. T. Chao", 1982, "A general purpose unequal probability sampling plan", "Biometrika 69(3), 653-656"
    ),
    "veach_1995": Citation(
        "E. Veach, L. J. Guibas",
        1995,
        "Optimally combining sampling techniques for Monte Carlo rendering",
        "SIGGRAPH 95, 419-428",
        "https://doi.org/10.1145/218380.218498",
    ),
    "hairer_1996": Citation(
        "E. Hairer, G. Wanner",
        1996,
        "Solving ordinary differential equations II: stiff and differential-algebraic problems",
        "Springer, 2nd edition",
        "https://doi.org/10.1007/978-3-642-05221-7",
    ),
    "kulla_2012": Citation(
        "C. Kulla, M. Fajardo",
        2012,
        "Importance sampling techniques for path tracing in participating media",
        "Computer Graphics Forum 31(4), 1519-1528",
        "https://doi.org/10.1111/j.1467-8659.2012.03148.x",
    ),
    "rousselle_2016": Citation(
        "F. Rousselle, W. Jarosz, J. Novák",
        2016,
        "Image-space control variates for rendering",
        "ACM Transactions on Graphics 35(6), 169",
    ),
    "miller_2019": Citation(
        "B. Miller, I. Georgiev, W. Jarosz",
        2019,
        "A null-scattering path integral formulation of light transport",
        "ACM Transactions on Graphics 38(4)",
        "https://doi.org/10.1145/3306346.3323025",
    ),
    "hofmann_2021": Citation(
        "N. Hofmann, J. Hasselgren, P. Clarberg, J. Munkberg",
        2021,
        "Interactive path tracing and reconstruction of sparse volumes",
        "Proceedings of the ACM on Computer Graphics and Interactive Techniques 4(1), 5",
    ),
    "mildenhall_2022": Citation(
        "B. Mildenhall, P. Hedman, R. Martin-Brualla, P. P. Srinivasan, J. T. Barron",
        2022,
        "NeRF in the Dark: High Dynamic Range View Synthesis from Noisy Raw Images",
        "CVPR",
        "https://arxiv.org/abs/2111.13679",
    ),
    "plenoctrees_2021": Citation(
        "A. Yu, R. Li, M. Tancik, H. Li, R. Ng, A. Kanazawa",
        2021,
        "PlenOctrees for Real-time Rendering of Neural Radiance Fields",
        "ICCV",
    ),
    "plenoxels_2022": Citation(
        "S. Fridovich-Keil, A. Yu, M. Tancik, Q. Chen, B. Recht, A. Kanazawa",
        2022,
        "Plenoxels: Radiance Fields without Neural Networks",
        "CVPR",
        "https://doi.org/10.1109/CVPR52688.2022.00542",
    ),
    "nerf_2020": Citation(
        "B. Mildenhall, P. P. Srinivasan, M. Tancik, J. T. Barron, R. Ramamoorthi, R. Ng",
        2020,
        "NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis",
        "ECCV",
        "https://arxiv.org/abs/2003.08934",
    ),
    "mueller_2022": Citation(
        "T. Müller, A. Evans, C. Schied, A. Keller",
        2022,
        "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding",
        "ACM Transactions on Graphics",
        "https://doi.org/10.1145/3528223.3530127",
    ),
    "kerbl_2023": Citation(
        "B. Kerbl, G. Kopanas, T. Leimkuehler, G. Drettakis",
        2023,
        "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
        "ACM Transactions on Graphics 42(4)",
        "https://arxiv.org/abs/2308.04079",
    ),
    "kheradmand_2024": Citation(
        "S. Kheradmand, D. Rebain, G. Sharma, W. Sun, Y.-C. Tseng, H. Isack, A. Kar, A. Tagliasacchi, K. M. Yi",
        2024,
        "3D Gaussian Splatting as Markov Chain Monte Carlo",
        "NeurIPS",
        "https://arxiv.org/abs/2404.09591",
    ),
    "zwicker_2001": Citation(
        "M. Zwicker, H. Pfister, J. van Baar, M. Gross", 2001, "EWA Volume Splatting", "IEEE Visualization"
    ),
    "wang_2004": Citation(
        "Z. Wang, A. C. Bovik, H. R. Sheikh, E. P. Simoncelli",
        2004,
        "Image Quality Assessment: From Error Visibility to Structural Similarity",
        "IEEE Transactions on Image Processing 13(4)",
    ),
    "relu_fields_2022": Citation(
        "A. Karnewar, T. Ritschel, O. Wang, N. J. Mitra",
        2022,
        "ReLU Fields: The Little Non-linearity That Could",
        "SIGGRAPH Conference Proceedings",
        "https://doi.org/10.1145/3528233.3530707",
    ),
    "max_1995": Citation(
        "N. Max",
        1995,
        "Optical models for direct volume rendering",
        "IEEE Transactions on Visualization and Computer Graphics 1(2), 99-108",
    ),
    "novak_2014": Citation(
        "J. Novák, A. Selle, W. Jarosz",
        2014,
        "Residual ratio tracking for estimating attenuation in participating media",
        "ACM Transactions on Graphics 33(6), 179",
    ),
    "novak_2018": Citation(
        "J. Novák, I. Georgiev, J. Hanika, W. Jarosz",
        2018,
        "Monte Carlo methods for volumetric light transport simulation",
        "Computer Graphics Forum 37(2), 551-576",
        "https://doi.org/10.1111/cgf.13383",
    ),
    "vicini_2021": Citation(
        "D. Vicini, S. Speierer, W. Jakob",
        2021,
        "Path replay backpropagation: differentiating light paths using constant memory and linear time",
        "ACM Transactions on Graphics 40(4), 108",
        "https://doi.org/10.1145/3450626.3459804",
    ),
    "woodcock_1965": Citation(
        "E. R. Woodcock, T. Murphy, P. J. Hemmings, T. C. Longworth",
        1965,
        "Techniques used in the GEM code for Monte Carlo neutronics calculations in reactors and other systems of complex "
        "geometry",
        "Applications of Computing Methods to Reactor Problems, Argonne National Laboratory, ANL-7050",
    ),
    "wilkie_2014": Citation(
        "A. Wilkie, S. Nawaz, M. Droske, A. Weidlich, J. Hanika",
        2014,
        "Hero wavelength spectral sampling",
        "Computer Graphics Forum 33(4)",
    ),
    "nimier_david_2022": Citation(
        "M. Nimier-David, T. Müller, A. Keller, W. Jakob",
        2022,
        "Unbiased inverse volume rendering with differential trackers",
        "ACM Transactions on Graphics 41(4)",
    ),
    "kettunen_2021": Citation(
        "M. Kettunen, E. d'Eon, J. Pantaleoni, J. Novák",
        2021,
        "An unbiased ray-marching transmittance estimator",
        "ACM Transactions on Graphics 40(4), 137",
        "https://doi.org/10.1145/3450626.3459937",
    ),
    "condor_2025": Citation(
        "J. Condor, S. Speierer, L. Bode, A. Božič, S. Green, P. Didyk, A. Jarabo",
        2025,
        "Don't splat your Gaussians: volumetric ray-traced primitives for modeling and rendering scattering and emissive media",
        "ACM Transactions on Graphics 44(1)",
        "https://doi.org/10.1145/3711853",
    ),
    "kak_1988": Citation("A. C. Kak, M. Slaney", 1988, "Principles of computerized tomographic imaging", "IEEE Press"),
    "gilbert_1972": Citation(
        "P. Gilbert",
        1972,
        "Iterative methods for the three-dimensional reconstruction of an object from projections",
        "Journal of Theoretical Biology 36(1), 105-117",
    ),
    "andersen_1984": Citation(
        "A. H. Andersen, A. C. Kak",
        1984,
        "Simultaneous algebraic reconstruction technique (SART): a superior implementation of the ART algorithm",
        "Ultrasonic Imaging 6(1), 81-94",
        "https://doi.org/10.1016/0161-7346(84)90008-7",
    ),
    "feldkamp_1984": Citation(
        "L. A. Feldkamp, L. C. Davis, J. W. Kress",
        1984,
        "Practical cone-beam algorithm",
        "Journal of the Optical Society of America A 1(6), 612-619",
        "https://doi.org/10.1364/josaa.1.000612",
    ),
    "vo_2018": Citation(
        "N. T. Vo, R. C. Atwood, M. Drakopoulos",
        2018,
        "Superior techniques for eliminating ring artifacts in X-ray micro-tomography",
        "Optics Express 26(22), 28396-28412",
        "https://doi.org/10.1364/OE.26.028396",
    ),
    "paganin_2002": Citation(
        "D. Paganin, S. C. Mayo, T. E. Gureyev, P. R. Miller, S. W. Wilkins",
        2002,
        "Simultaneous phase and amplitude extraction from a single defocused image of a homogeneous object",
        "Journal of Microscopy 206(1), 33-40",
        "https://doi.org/10.1046/j.1365-2818.2002.01010.x",
    ),
    "penczek_1994": Citation(
        "P. A. Penczek, R. A. Grassucci, J. Frank",
        1994,
        "The ribosome at improved resolution: new techniques for merging and orientation refinement in 3D cryo-electron "
        "microscopy of biological particles",
        "Ultramicroscopy 53(3), 251-270",
        "https://doi.org/10.1016/0304-3991(94)90038-8",
    ),
    "krumm_2008": Citation(
        "M. Krumm, S. Kasperl, M. Franz",
        2008,
        "Reducing non-linear artifacts of multi-material objects in industrial 3D computed tomography",
        "NDT & E International 41(4), 242-251",
        "https://doi.org/10.1016/j.ndteint.2007.12.001",
    ),
    "golub_1973": Citation(
        "G. H. Golub, V. Pereyra",
        1973,
        "The differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate",
        "SIAM Journal on Numerical Analysis 10(2), 413-432",
        "https://doi.org/10.1137/0710036",
    ),
    "eilers_2003": Citation(
        "P. H. C. Eilers",
        2003,
        "A perfect smoother",
        "Analytical Chemistry 75(14), 3631-3636",
        "https://doi.org/10.1021/ac034173t",
    ),
    "parker_1982": Citation(
        "D. L. Parker",
        1982,
        "Optimal short scan convolution reconstruction for fan beam CT",
        "Medical Physics 9(2), 254-257",
        "https://doi.org/10.1118/1.595078",
    ),
    "nuyts_1998": Citation(
        "J. Nuyts, B. De Man, P. Dupont, M. Defrise, P. Suetens, L. Mortelmans",
        1998,
        "Iterative reconstruction for helical CT: a simulation study",
        "Physics in Medicine and Biology 43, 729-737",
    ),
    "erdogan_1999": Citation(
        "H. Erdoğan, J. A. Fessler",
        1999,
        "Ordered subsets algorithms for transmission tomography",
        "Physics in Medicine and Biology 44(11), 2835-2851",
    ),
    "vo_2014": Citation(
        "N. T. Vo, M. Drakopoulos, R. C. Atwood, C. Reinhard",
        2014,
        "Reliable method for calculating the center of rotation in parallel-beam tomography",
        "Optics Express 22(16), 19078",
        "https://doi.org/10.1364/OE.22.019078",
    ),
    "hestenes_1952": Citation(
        "M. R. Hestenes, E. Stiefel",
        1952,
        "Methods of conjugate gradients for solving linear systems",
        "Journal of Research of the National Bureau of Standards 49(6), 409-436",
        "https://doi.org/10.6028/jres.049.044",
    ),
    "liu_1989": Citation(
        "D. C. Liu, J. Nocedal",
        1989,
        "On the limited memory BFGS method for large scale optimization",
        "Mathematical Programming 45, 503-528",
    ),
    "kingma_2015": Citation(
        "D. P. Kingma, J. Ba",
        2015,
        "Adam: a method for stochastic optimization",
        "International Conference on Learning Representations",
        "https://arxiv.org/abs/1412.6980",
    ),
    "rudin_1992": Citation(
        "L. I. Rudin, S. Osher, E. Fatemi",
        1992,
        "Nonlinear total variation based noise removal algorithms",
        "Physica D 60(1-4), 259-268",
        "https://doi.org/10.1016/0167-2789(92)90242-F",
    ),
    "huber_1964": Citation(
        "P. J. Huber",
        1964,
        "Robust estimation of a location parameter",
        "Annals of Mathematical Statistics 35(1), 73-101",
        "https://doi.org/10.1214/aoms/1177703732",
    ),
    "shepp_1974": Citation(
        "L. A. Shepp, B. F. Logan",
        1974,
        "The Fourier reconstruction of a head section",
        "IEEE Transactions on Nuclear Science 21(3), 21-43",
        "https://doi.org/10.1109/TNS.1974.6499235",
    ),
    "tigre": Citation(
        "A. Biguri, M. Dosanjh, S. Hancock, M. Soleimani",
        2016,
        "TIGRE: a MATLAB-GPU toolbox for CBCT image reconstruction",
        "Biomedical Physics & Engineering Express 2(5), 055010",
        "https://doi.org/10.1088/2057-1976/2/5/055010",
    ),
    "leap": Citation(
        "H. Kim, K. Champley",
        2023,
        "Differentiable forward projector for X-ray computed tomography",
        "ICML workshop; arXiv",
        "https://arxiv.org/abs/2307.05801",
    ),
    "astra": Citation(
        "W. van Aarle, W. J. Palenstijn, J. Cant, E. Janssens, F. Bleichrodt, A. Dabravolski, J. De Beenhouwer, "
        "K. J. Batenburg, J. Sijbers",
        2016,
        "Fast and flexible X-ray tomography using the ASTRA Toolbox",
        "Optics Express 24(22), 25129-25147",
        "https://doi.org/10.1364/OE.24.025129",
    ),
    "tomobank": Citation(
        "F. De Carlo, D. Gürsoy, D. J. Ching, K. J. Batenburg, W. Ludwig, L. Mancini, F. Marone, R. Mokso, D. M. Pelt, "
        "J. Sijbers, M. Rivers",
        2018,
        "TomoBank: a tomographic data repository for computational x-ray science",
        "Measurement Science and Technology 29(3), 034004",
        "https://doi.org/10.1088/1361-6501/aa9c19",
    ),
}


def list_citations(keys: Iterable[str]) -> list[Citation]:
    """References for ``keys``, in the order of their first mention, each once.

    Raises:
        MivolError: a key is not in the table; the nearest one is offered.
    """
    found = []
    for key in dict.fromkeys(keys):
        if key not in CITATIONS:
            near = get_close_matches(key, CITATIONS, n=1, cutoff=0.5) or sorted(CITATIONS)
            raise MivolError(f'no citation has the key "{key}"; use {", ".join(near)}.')
        found.append(CITATIONS[key])
    return found
